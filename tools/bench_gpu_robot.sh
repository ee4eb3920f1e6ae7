#!/usr/bin/env bash
# Measures the robot's worlds in MJX-Warp on a GPU, the most wanted figures first: bench_gpu_robot.sh [FILE] [LIMIT]
# FILE (default: robot-gpu.jsonl) gets a line of JSON for each as it comes, or says which case failed; LIMIT (default: 600) is
# after how many seconds no other case begins. Each case has a process of its own, so that none meets what another compiled.
set -u
cd "$(dirname "$0")/.."
file=${1:-robot-gpu.jsonl} limit=${2:-600} python=${PYTHON:-python3}
export XLA_PYTHON_CLIENT_MEM_FRACTION=${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.55} PYTHONUNBUFFERED=1
case_() { # SECONDS JSON
  [ "$SECONDS" -ge "$limit" ] && { echo "{\"left_out\": $2}" >> "$file"; return; }
  timeout "$1" "$python" -m bson.bench_warp "$2" "$engine" > "$file.out" 2> "$file.err"
  local code=$?
  if [ $code = 0 ]; then tail -n 1 "$file.out" >> "$file"; else
    "$python" - "$2" $code "$file.err" >> "$file" <<'PY'
import json, sys
case, code, err = sys.argv[1:]
print(json.dumps({"failed": json.loads(case), "code": int(code), "why": open(err, errors="replace").read()[-1500:]}))
PY
  fi
  tail -n 1 "$file"
  return $code
}
engine='{}'
# The first case also compiles Warp's kernels, about a minute.
case_ 200 '{"sensor": "lidar2d", "worlds": 4096, "seconds": 4}' || {
  engine='{"graph": false}' # then CUDA graphs may be at fault
  case_ 150 '{"sensor": "lidar2d", "worlds": 4096, "seconds": 4}'
}
case_ 90 '{"sensor": "none", "worlds": 4096, "seconds": 4}'
case_ 90 '{"sensor": "camera", "worlds": 1024, "seconds": 4}'
case_ 90 '{"sensor": "lidar3d", "worlds": 2048, "seconds": 4}'
case_ 90 '{"train": true, "worlds": 4096, "seconds": 6}'
case_ 90 '{"sensor": "none", "worlds": 16384, "seconds": 4}'
case_ 90 '{"sensor": "lidar2d", "worlds": 16384, "seconds": 4}'
case_ 120 '{"sensor": "none", "worlds": 4096, "seconds": 4, "engine": {"solver": "cg", "iterations": 20}}'
case_ 90 '{"sensor": "none", "worlds": 4096, "seconds": 4, "engine": {"iterations": 4, "ls_iterations": 8}}'
case_ 90 '{"sensor": "none", "worlds": 1024, "seconds": 4}'
case_ 90 '{"sensor": "lidar2d", "worlds": 1024, "seconds": 4}'
case_ 150 '{"sensor": "lidar2d", "worlds": 4096, "people": 50, "seconds": 4}'
