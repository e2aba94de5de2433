# SPDX-License-Identifier: MIT
"""Names of a model process's settings: folder in its version, parameters in config.pbtxt, environment variables.

``rfm_client.contract.description`` has the parameter that describes the checkpoint.
"""

CHECKPOINT_FOLDER = "checkpoint"  # in a version of a scoring model

EXPORT_PARAMETER = "export_version"
EXPORT_VERSION = "2"  # raise it if a change of model.py or its parameters makes earlier exports unusable

THREADS_PARAMETER = "torch_threads"
BUDGET_PARAMETER = "token_budget"
SAMPLE_TOKENS_PARAMETER = "max_sample_tokens"
FAMILY_PARAMETER = "family"  # the package of the checkpoint's family
DTYPE_PARAMETER = "dtype"  # empty: as checkpoint and device decide
FEATURE_CACHE_PARAMETER = "feature_cache_mib"  # 0: no cache
PYTHON_PARAMETERS = (THREADS_PARAMETER, BUDGET_PARAMETER, SAMPLE_TOKENS_PARAMETER, DTYPE_PARAMETER, FAMILY_PARAMETER)
GRAPHS_PARAMETER = "cuda_graphs"  # present only if it is on

HANG_VARIABLE = "RFM_HANG_S"  # seconds without progress of a batch after which the process ends
DEFAULT_HANG_S = 120
