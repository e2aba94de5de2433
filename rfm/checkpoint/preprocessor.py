# SPDX-License-Identifier: MIT
"""What preprocessor_config.json, as transformers writes it, says in numbers."""

PREPROCESSOR_CONFIG = "preprocessor_config.json"  # beside a model's weights: how its images are made
MAX_UINT8 = 255
PIL_BICUBIC = 3  # the value of `resample` in it
