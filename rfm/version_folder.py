# SPDX-License-Identifier: MIT
"""Names of the folders in an exported version of a model, where the export writes and the model process reads."""

CHECKPOINT_FOLDER = "checkpoint"  # in a model that scores
PROCESSOR_FOLDER = "processor"  # in a vision-language checkpoint: its tokenizer and image preprocessing
IMAGE_ENCODER_FOLDER = "image_encoder"  # in a model that encodes
TEXT_ENCODER_FOLDER = "text_encoder"
