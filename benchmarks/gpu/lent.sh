#!/bin/bash
# Measures in three calls of at most ten minutes each, on a GPU that is lent by the minute (METHOD.md).
#
#   bash benchmarks/gpu/lent.sh 1 OUT                ceilings, parity, tests, sanitizer as far as time allows
#   bash benchmarks/gpu/lent.sh 2 OUT                kernels and iterations, beside gsplat and the official rasterizer
#   bash benchmarks/gpu/lent.sh 3 OUT CAPTURE ...    whole runs: a tenth of the schedule, then all of it
#
# Results are in OUT/gpu_*.json after every part, whatever stops the rest. Needs no index and nothing installed: it takes
# .venv or the first Python >= 3.11 whose torch is built with CUDA. MINUTES=9 and DRY=--dry-run (no GPU: toy sizes,
# emulated) may be set. The exit status is that of the measurement: 0, 1 (something is wrong), 2 (cannot run), 124 (time).
set -u
cd "$(dirname "$0")/../.." || exit 2
part=${1:-}; out=${2:-}
case "$part" in 1 | 2 | 3) ;; *) sed -n '2,6s/^# \{0,1\}//p' "$0" >&2; exit 2 ;; esac
[ -n "$out" ] && mkdir -p "$out" || { echo "error: lent.sh: a folder for results was expected after the part, got '$out'" >&2; exit 2; }
out=$(cd "$out" && pwd)
shift 2
minutes=${MINUTES:-9}
dry=${DRY:-}
export PYTHONPATH="src${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1

fits() {  # says why a Python does not
    "$1" - "$dry" 2>&1 <<'PY' | tail -1
import sys
if sys.version_info < (3, 11):
    sys.exit("Python %d.%d, 3.11 or newer is needed" % sys.version_info[:2])
import numpy, PIL, scipy, torch
if torch.version.cuda is None and not sys.argv[1]:
    sys.exit("torch %s is built without CUDA" % torch.__version__)
PY
}
python=
for candidate in .venv/bin/python python3 python3.13 python3.12 python3.11 python; do
    command -v "$candidate" >/dev/null || continue
    why=$(fits "$candidate")
    [ -z "$why" ] && { python=$candidate; break; }
    echo "$candidate: $why" >&2
done
[ -n "$python" ] || { echo "error: lent.sh: no Python fits; run make install, or put one with torch's CUDA build on the PATH" >&2; exit 2; }
[ -n "${GS2D_COMMIT:-}" ] || GS2D_COMMIT=$(git describe --always --dirty 2>/dev/null) && export GS2D_COMMIT
"$python" -m gs2d doctor >"$out/doctor.txt" 2>&1
grep -h "cuda" "$out/doctor.txt" || true

measure() {  # a command within the time that is left; a kill comes half a minute after it was to stop by itself
    local left=$(($(date +%s) < end ? end - $(date +%s) : 0))
    timeout -k 5 $((left + 30)) "$python" -m benchmarks.gpu "$@" --minutes "$(awk "BEGIN{print $left/60}")" $dry
}
end=$(awk "BEGIN{print int($(date +%s) + 60 * $minutes)}")
case "$part" in
    1) measure correctness --out "$out/gpu_correctness.json" ;;
    2) measure kernels --out "$out/gpu_kernels.json" ;;
    3)
        [ $# -gt 0 ] || [ -n "$dry" ] || { echo "error: lent.sh: part 3 needs captures after the folder" >&2; exit 2; }
        captures=()
        [ $# -eq 0 ] || captures=(--capture "$@")
        short=(--schedule-scale 0.1 --runs "$out/runs-0.1" --out "$out/gpu_training_0.1.json")
        measure training "${short[@]}" "${captures[@]}" &&
            measure training --runs "$out/runs" --out "$out/gpu_training.json" "${captures[@]}"
        ;;
esac
