#!/bin/sh
# Install the 64-bit Arm wheel with an Arm Python under QEMU, run `gs2d doctor` from it, and compare images, gradients
# and a short training with this machine (scripts/compare_machines.py).
# Usage: scripts/check_aarch64.sh WHEEL PYTHON
#        (Debian, as root, on x86-64: apt install qemu-user-static debootstrap; PYTHON must import gs2d of the same
#        sources, installed or through PYTHONPATH)
#
# The script changes no machine settings: Debian packages are unpacked into a temporary folder without configuration,
# and QEMU is invoked explicitly. torch is 2.10.0, whose Arm wheel needs no CUDA libraries.
set -eu
[ $# = 2 ] || { sed -n "s/^# *//; 4,6p" "$0" >&2; exit 2; }
wheel=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
case $wheel in *_aarch64.whl) ;; *) echo "error: needs a wheel of aarch64, got $1" >&2; exit 2 ;; esac
here=$2
scripts=$(cd "$(dirname "$0")" && pwd)
for program in qemu-aarch64-static debootstrap; do
    command -v $program >/dev/null ||
        { echo "error: needs $program; on Debian: apt install qemu-user-static debootstrap" >&2; exit 2; }
done
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
root="$work/root"
# The first stage of debootstrap downloads all packages and unpacks the required ones; unpack the rest here.
debootstrap --foreign --arch=arm64 --variant=minbase --include=python3,python3-pip-whl,ca-certificates \
    bookworm "$root" >"$work/log" 2>&1 || { tail "$work/log" >&2; exit 1; }
for package in "$root"/var/cache/apt/archives/*.deb; do
    dpkg-deb --fsys-tarfile "$package" | tar -x --keep-directory-symlink -C "$root"
done
site="$work/site"
arm() {    # run the Arm Python with the installed packages
    PYTHONPATH="$site" PYTHONDONTWRITEBYTECODE=1 OMP_NUM_THREADS=1 \
        qemu-aarch64-static -L "$root" "$root/usr/bin/python3" "$@"
}
cd "$work"    # outside the checkout, so that it cannot be imported
pip=$(echo "$root"/usr/share/python-wheels/pip-*.whl)
# Run pip under QEMU, so that it selects wheels for that processor and C library.
arm "$pip/pip" --disable-pip-version-check -q install --only-binary :all: --no-compile --target "$site" \
    torch==2.10.0 "$wheel"
arm -m gs2d --version
arm -m gs2d doctor | tee doctor
grep -q 'yes  cpu: portable' doctor || { echo "error: the wheel must bring the native kernels" >&2; exit 1; }
OMP_NUM_THREADS=1 GS2D_CPU_VARIANT=portable "$here" "$scripts/compare_machines.py" make here.npz --capture capture
arm "$scripts/compare_machines.py" make arm.npz --capture capture
"$here" "$scripts/compare_machines.py" compare here.npz arm.npz
