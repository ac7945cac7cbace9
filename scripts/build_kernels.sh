#!/bin/sh
# Build the CPU kernels of a source checkout into src/gs2d/kernels/lib/ (git-ignored).
# Usage: scripts/build_kernels.sh [cmake options, e.g. -DCMAKE_CXX_COMPILER=clang++]
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
build="$root/build/kernels"
generator=""
if command -v ninja >/dev/null 2>&1 && [ ! -f "$build/CMakeCache.txt" ]; then generator="-G Ninja"; fi
# shellcheck disable=SC2086
cmake -S "$root" -B "$build" $generator "$@" >"${TMPDIR:-/tmp}/gs2d_cmake.$$.log" 2>&1 || {
    cat "${TMPDIR:-/tmp}/gs2d_cmake.$$.log"; rm -f "${TMPDIR:-/tmp}/gs2d_cmake.$$.log"; exit 1; }
rm -f "${TMPDIR:-/tmp}/gs2d_cmake.$$.log"
cmake --build "$build" --parallel 2
cmake --install "$build" >/dev/null
ls "$root/src/gs2d/kernels/lib"
