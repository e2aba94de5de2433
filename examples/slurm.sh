#!/bin/bash
# SPDX-License-Identifier: MIT
# Serve my_models beside a training on one node. train.py calls RewardClient(os.environ["RFM_URL"]).
#SBATCH --gres=gpu:1 --cpus-per-task=8 --time=08:00:00

. .venv/bin/activate
ports=$((20000 + ${SLURM_JOB_ID:-0} % 10000 * 3))  # of this job alone: jobs may share a node
export RFM_URL=grpc://127.0.0.1:$((ports + 1))

rfm serve --repository my_models --http-port $ports --grpc-port $((ports + 1)) --metrics-port $((ports + 2)) \
  > serve.log 2>&1 &
server=$!
trap 'kill $server; wait $server' EXIT

rfm-client wait --timeout 600 || exit 1
python train.py
