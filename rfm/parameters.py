# SPDX-License-Identifier: MIT
"""What a model process is told: its version's folder, parameters in config.pbtxt, variables of rfm serve."""

CHECKPOINT_FOLDER = "checkpoint"  # in a version of a model that scores

THREADS_PARAMETER = "torch_threads"
BUDGET_PARAMETER = "token_budget"
SAMPLE_TOKENS_PARAMETER = "max_sample_tokens"
FAMILY_PARAMETER = "family"  # the package of its checkpoint's family
DTYPE_PARAMETER = "dtype"  # empty: as the checkpoint and the device decide
FEATURE_CACHE_PARAMETER = "feature_cache_mb"  # 0: nothing is kept
OLD_QUEUE_PARAMETERS = ("max_queue_size", "queue_timeout_ms")  # of exports before Triton's queue was bounded itself

HANG_VARIABLE = "RFM_HANG_S"  # after how many seconds without progress of a batch it ends
DEFAULT_HANG_S = 120
