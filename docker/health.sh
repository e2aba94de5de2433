#!/bin/sh
# SPDX-License-Identifier: MIT
# Ends with 0 if the server scores a synthetic sample: embeddings, or raw frames of a checkpoint that takes nothing else.
# RFM_URL names a server that is not on this host's default port, RFM_MODEL a checkpoint not exported as rfm,
# RFM_API_KEY_FILE the key that the server asks for.
set -u

exec rfm-client sample --model "${RFM_MODEL:-rfm}" --num-samples 1 --num-frames 2 --timeout 15 --json -
