# SPDX-License-Identifier: MIT
"""Files of a checkpoint, of whatever family: found, read, checked, digested.

A checkpoint is a local folder or a Hugging Face id ``org/name[/subfolder][@tag]``. In it: ``model.safetensors`` (or
shards with an index, or an adapter), ``config.json`` (the network) and, in the folder, its parent or on main of the
Hub's repository, ``config.yaml`` (the training run). Nothing in a checkpoint is executed: safetensors only, and YAML
tags construct nothing.
"""
