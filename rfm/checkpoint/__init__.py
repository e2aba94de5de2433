# SPDX-License-Identifier: MIT
"""Files of a checkpoint of any family: find, read, check and digest them.

A checkpoint is a local folder or a Hugging Face id ``org/name[/subfolder][@tag]``. It holds ``model.safetensors`` (or
shards with an index, or an adapter) and ``config.json`` (the network). ``config.yaml`` (the training run) is there,
in the parent folder, or on main of the Hub's repository. Nothing in a checkpoint is executed: weights are read from
safetensors alone, and YAML tags construct no objects.
"""
