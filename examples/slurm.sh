#!/bin/sh
#SBATCH --array=0-3
#SBATCH --cpus-per-task=2
#SBATCH --mem=4G
# Each job of the array takes its share of the lines in jobs.txt. When all are done, `nerfbake batch --state run
# --report run/report.html` judges the whole. --take-over: the lock of a job that was killed is nobody's.

exec nerfbake batch --jobs-file jobs.txt --state run \
    --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" -j "${SLURM_CPUS_PER_TASK:-1}" --take-over
