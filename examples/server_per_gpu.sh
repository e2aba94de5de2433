#!/bin/bash
# SPDX-License-Identifier: MIT
# Serve my_models, exported with --num-gpus 1, by a server on each of eight GPUs: grpc://127.0.0.1:8001, :8011, ...
trap 'kill $(jobs -p); wait' EXIT
for gpu in 0 1 2 3 4 5 6 7; do
  CUDA_VISIBLE_DEVICES=$gpu rfm serve my_models \
    --http-port 80${gpu}0 --grpc-port 80${gpu}1 --metrics-port 80${gpu}2 > serve_$gpu.log 2>&1 &
done
wait
