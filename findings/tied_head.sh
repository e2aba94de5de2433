#!/bin/sh
# A Qwen3-VL whose text_config alone ties the weights: transformers 4.57 obeys that flag, ties, and saves no head.
# transformers 5 obeys the outer flag, which 4.57 wrote as false into the same folder, and gives the model a random
# head: other logits each time it is loaded, with a warning. Both read a folder whose two flags are true alike.
#
# Seen with transformers 4.57.6 and 5.24.0, torch 2.13.0, Python 3.11.
# Needs Python 3.10 to 3.13 and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 4.57.6 5.24.0; do
  python3 -m venv "$folder/$version"
  "$folder/$version/bin/pip" install --quiet --disable-pip-version-check transformers==$version torch==2.13.0 \
    numpy==2.3.5
done
cd "$folder"
cat > save.py <<'PYTHON'
import json

import torch
from safetensors import safe_open
from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

TEXT = {"vocab_size": 64, "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1, "head_dim": 16}
TEXT |= {"num_attention_heads": 2, "num_key_value_heads": 1, "tie_word_embeddings": True}
TEXT |= {"rope_scaling": {"mrope_interleaved": True, "mrope_section": [2, 3, 3], "rope_type": "default"}}
VISION = {"depth": 1, "hidden_size": 32, "intermediate_size": 64, "num_heads": 2, "out_hidden_size": 32}
VISION |= {"deepstack_visual_indexes": [0], "num_position_embeddings": 16}

torch.manual_seed(0)
for name, flags in {"text": {}, "both": {"tie_word_embeddings": True}}.items():
    config = Qwen3VLConfig(text_config=TEXT, vision_config=VISION, **flags)
    Qwen3VLForConditionalGeneration(config).save_pretrained(name)
    with safe_open(f"{name}/model.safetensors", "pt") as weights:
        assert not any("lm_head" in key for key in weights.keys())
    with open(f"{name}/config.json") as file:
        assert json.load(file)["tie_word_embeddings"] is (name == "both")
PYTHON
cat > load.py <<'PYTHON'
import torch
import transformers
from transformers import Qwen3VLForConditionalGeneration

transformers.utils.logging.set_verbosity_error()
transformers.utils.logging.disable_progress_bar()
for name in ("both", "text"):
    models = [Qwen3VLForConditionalGeneration.from_pretrained(name).eval() for _ in range(2)]
    is_tied = torch.equal(models[0].lm_head.weight, models[0].get_input_embeddings().weight)
    with torch.no_grad():
        logits = [model(input_ids=torch.tensor([[1, 2, 3]])).logits for model in models]
    is_same = torch.equal(*logits)
    print(f"transformers {transformers.__version__}, tied by {name}: tied {is_tied}, loaded twice the same {is_same}")
    assert is_tied == is_same == (name == "both" or transformers.__version__.startswith("4.")), name
PYTHON
4.57.6/bin/python -W ignore save.py
for version in 4.57.6 5.24.0; do $version/bin/python -W ignore load.py; done
