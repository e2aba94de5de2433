# SPDX-License-Identifier: MIT
"""Names of a model process's settings: folder in its version, parameters in config.pbtxt, environment variables.

``rfm_client.contract.description`` has the parameter that describes the checkpoint.
"""

CHECKPOINT_FOLDER = "checkpoint"  # in a scoring model's version folder

EXPORT_PARAMETER = "export_version"
EXPORT_VERSION = "2"  # raise it if a change to model.py or its parameters makes earlier exports unusable

THREADS_PARAMETER = "torch_threads"
BUDGET_PARAMETER = "token_budget"
SAMPLE_TOKENS_PARAMETER = "max_sample_tokens"
FAMILY_PARAMETER = "family"  # the package of the checkpoint's family
DTYPE_PARAMETER = "dtype"  # empty: as checkpoint and device decide
FEATURE_CACHE_PARAMETER = "feature_cache_mib"  # 0: no cache
PYTHON_PARAMETERS = (THREADS_PARAMETER, BUDGET_PARAMETER, SAMPLE_TOKENS_PARAMETER, DTYPE_PARAMETER, FAMILY_PARAMETER)
GRAPHS_PARAMETER = "cuda_graphs"  # present only if graphs are on

HANG_VARIABLE = "RFM_HANG_S"  # the process ends after a batch makes no progress for this many seconds
DEFAULT_HANG_S = 120
