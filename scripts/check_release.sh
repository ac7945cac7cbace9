#!/bin/sh
# Install a wheel into an empty environment, from wheels only (no compiler), and run a short demo.
# Usage: scripts/check_release.sh WHEEL [PYTHON]     (the environment is a temporary folder; torch is downloaded)
set -eu
wheel=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${2:-python3}" -m venv "$work/env"
pip="$work/env/bin/pip --disable-pip-version-check -q install --only-binary :all:"
cd "$work"    # outside the checkout, so that it cannot be imported
unset PYTHONPATH
started=$(date +%s)
$pip torch
with_torch=$(date +%s)
$pip "$wheel"
done_=$(date +%s)
echo "torch $((with_torch - started)) s, gs2d and the rest $((done_ - with_torch)) s"
env/bin/gs2d --version
env/bin/gs2d doctor | grep 'yes  cpu' || { echo "error: the wheel must bring the native kernels" >&2; exit 1; }
env/bin/gs2d demo --out demo --schedule-scale 0.02 --set page=false
[ -s demo/mesh.ply ] && [ -s demo/report.html ]
