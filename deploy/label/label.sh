#!/bin/sh
# Labels one part of a data set: part INDEX of PARTS writes its range of the SCENES to DATA/part-INDEX. Arguments are
# passed to `grasp-sim label`. When a part is started again it continues where it stopped.
set -eu

: "${DATA:?set it to the shared folder}"
: "${SCENES:?set it to the number of scenes}"
: "${PARTS:?set it to the number of parts}"
# The index of a pod in a Kubernetes Indexed Job, or of a task in a Slurm array.
INDEX=${JOB_COMPLETION_INDEX:-${SLURM_ARRAY_TASK_ID:?set it to the index of this part, from 0}}
[ "$INDEX" -lt "$PARTS" ] || { echo "the index of this part is $INDEX, must be less than PARTS, $PARTS" >&2; exit 1; }

first=$((SCENES * INDEX / PARTS))
end=$((SCENES * (INDEX + 1) / PARTS))
exec grasp-sim label --first "$first" --scenes $((end - first)) --out "$DATA/part-$INDEX" "$@"
