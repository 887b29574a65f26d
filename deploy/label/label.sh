#!/bin/sh
# One machine's share of a data set. Part INDEX of PARTS labels its range of the SCENES into DATA/part-INDEX; what the
# machine is told besides goes to `grasp-sim label`. A machine that was lost takes its part up where it stopped.
set -eu

: "${DATA:?is the folder that all machines see}" "${SCENES:?is the number of scenes}" "${PARTS:?is the number of machines}"
# Kubernetes numbers the pods of an Indexed Job so, Slurm the tasks of an array.
INDEX=${JOB_COMPLETION_INDEX:-${SLURM_ARRAY_TASK_ID:?is the number of this machine, from 0}}

first=$((SCENES * INDEX / PARTS))
end=$((SCENES * (INDEX + 1) / PARTS))
exec grasp-sim label --first "$first" --scenes $((end - first)) --out "$DATA/part-$INDEX" "$@"
