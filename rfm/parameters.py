# SPDX-License-Identifier: MIT
"""Names of the parameters in config.pbtxt that rfm_export writes and a model process reads."""

THREADS_PARAMETER = "torch_threads"
BUDGET_PARAMETER = "token_budget"
SAMPLE_TOKENS_PARAMETER = "max_sample_tokens"
FAMILY_PARAMETER = "family"  # the package of its checkpoint's family
DTYPE_PARAMETER = "dtype"  # empty: as the checkpoint and the device decide
QUEUE_SIZE_PARAMETER = "max_queue_size"  # empty: any number
QUEUE_TIMEOUT_PARAMETER = "queue_timeout_ms"  # empty: any time
FEATURE_CACHE_PARAMETER = "feature_cache_mb"  # 0: nothing is kept
