#!/bin/bash
# Run the GPU measurements in five calls, for machines with limited time (METHOD.md). Run part 0 first.
#
#   bash benchmarks/gpu/lent.sh 0 OUT                three minutes: machine, every kernel once, parity, time breakdown
#   bash benchmarks/gpu/lent.sh 1 OUT                kernels and iterations, counters, comparison with gsplat
#   bash benchmarks/gpu/lent.sh 2 OUT [CAPTURE ...]  whole runs of captures and of a synthetic capture
#   bash benchmarks/gpu/lent.sh 3 OUT                ceilings, parity, tests, sanitizers if time allows
#   bash benchmarks/gpu/lent.sh 4 OUT [CAPTURE]      all installed rasterizers on a capture; call it again for the rest
#
# Results are written to OUT/gpu_*.json after every measurement. Reports, traces and logs are packed into
# OUT/part_N.tar.gz. Each part thus leaves two small files and no folders. The script needs no package index and installs
# nothing: it uses .venv or the first Python >= 3.11 whose torch is built with CUDA. It uses captures/* and *.whl in
# carried/ (for instance gsplat: METHOD.md). Variables: MINUTES (8.3; 3 for part 0) and DRY=--dry-run (no GPU: emulated,
# toy sizes). Exit status: that of the measurement: 0, 1 (a check failed), 2 (cannot run), 124 (time limit).
begun=$(date +%s)
set -u
cd "$(dirname "$0")/../.." || exit 2
part=${1:-}; out=${2:-}
case "$part" in 0 | 1 | 2 | 3 | 4) ;; *) sed -n '2,8s/^# \{0,1\}//p' "$0" >&2; exit 2 ;; esac
[ -n "$out" ] && mkdir -p "$out" || { echo "error: lent.sh: a folder for results was expected after the part, got '$out'" >&2; exit 2; }
out=$(cd "$out" && pwd)
shift 2
minutes=${MINUTES:-$([ "$part" = 0 ] && echo 3 || echo 8.3)}
end=$(awk "BEGIN{print int($begun + 60 * $minutes)}")
dry=${DRY:-}
work=$(mktemp -d "${TMPDIR:-/tmp}/gs2d.XXXXXX") || exit 2
export PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1 GS2D_WORK=$work

left() { echo $(($(date +%s) < end ? end - $(date +%s) : 0)); }

fits() {  # check a Python by its exit status; messages printed during imports are ignored
    timeout -k 5 $(($(left) + 30)) "$1" -W ignore - "$dry" 2>"$work/python.err" <<'PY'
import sys
if sys.version_info < (3, 11):
    sys.exit(print("Python %d.%d, 3.11 or newer is needed" % sys.version_info[:2]) or 1)
try:
    import numpy, PIL, scipy, torch
except ImportError as error:
    sys.exit(print(error) or 1)
if torch.version.cuda is None and not sys.argv[1]:
    sys.exit(print("torch %s is built without CUDA" % torch.__version__) or 1)
PY
}
python=
for candidate in .venv/bin/python python3 python3.13 python3.12 python3.11 python; do
    command -v "$candidate" >/dev/null || continue
    if why=$(fits "$candidate"); then
        python=$candidate
        break
    fi
    echo "$candidate: ${why:-$(tail -n 1 "$work/python.err")}" >&2
done
[ -n "$python" ] || { echo "error: lent.sh: no Python fits; run make install, or put one with torch's CUDA build on the PATH" >&2; rm -rf "$work"; exit 2; }
[ -n "${GS2D_COMMIT:-}" ] || GS2D_COMMIT=$(git describe --always --dirty 2>/dev/null) && export GS2D_COMMIT
trap '"$python" -m benchmarks.gpu.archive "$work" "$out/part_$part.tar.gz"; rm -rf "$work"' EXIT

measure() {  # run a command within the remaining time; kill it half a minute after its own deadline
    timeout -k 5 $(($(left) + 30)) "$python" -m benchmarks.gpu "$@" --minutes "$(awk "BEGIN{print $(left)/60}")" $dry \
        > >(tee -a "$work/log.txt") 2> >(tee -a "$work/log.txt" >&2)
}
if ls carried/*.whl >/dev/null 2>&1; then  # pure Python wheels, or wheels for this Python
    timeout 60 "$python" -m pip install -q --no-index --no-deps --target "$work/.site" carried/*.whl >>"$work/log.txt" 2>&1
    export PYTHONPATH="$PYTHONPATH:$work/.site"
fi
case "$part" in
    0) measure first --out "$out/gpu_first.json" ;;
    1)
        export TORCH_EXTENSIONS_DIR="$work/.extensions"
        if [ -z "$dry" ] && command -v nvcc >/dev/null && ls carried/gsplat-*.whl >/dev/null 2>&1; then
            # compile gsplat's kernels on other cores during the first measurements; gsplat is measured last
            (timeout -k 5 "$(left)" nice "$python" -W ignore -c 'from benchmarks.gpu.peers import build_gsplat as b; b()' \
                >"$work/gsplat.txt" 2>&1 &)
        fi
        measure kernels --out "$out/gpu_kernels.json"
        ;;
    2)
        captures=("$@")
        [ $# -gt 0 ] || for folder in carried/captures/*/; do [ -d "$folder" ] && captures+=("$folder"); done
        measure training --runs "$work/runs" --out "$out/gpu_training.json" --synthetic --capture ${captures[@]+"${captures[@]}"}
        ;;
    3) measure correctness --out "$out/gpu_correctness.json" ;;
    4)
        export TORCH_EXTENSIONS_DIR="$work/.extensions"
        captures=("$@")
        [ $# -gt 0 ] || for folder in carried/captures/*/; do [ -d "$folder" ] && captures=("$folder") && break; done
        measure peers --out "$out/gpu_peers.json" --runs "$work/.splats" --capture ${captures[@]+"${captures[@]}"}
        ;;
esac
