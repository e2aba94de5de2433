#!/bin/sh
# Weights in NF4 that transformers 5 has turned back into floats with dequantize() cannot be saved: save_pretrained
# raises NotImplementedError, since it reverses the conversions of loading, and quantization has no reverse. With
# save_original_format=False they are saved, and load as an ordinary model.
#
# Seen with transformers 5.24.0, bitsandbytes 0.50.2, accelerate 1.15.0 and torch 2.13.0, Python 3.11, on a CPU.
# Needs Python 3.10 to 3.13 and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check transformers==5.24.0 bitsandbytes==0.50.2 \
  accelerate==1.15.0 torch==2.13.0
cd "$folder"
cat > save.py <<'PYTHON'
import torch
import transformers
from transformers import BitsAndBytesConfig, Qwen3Config, Qwen3ForCausalLM

transformers.utils.logging.set_verbosity_error()
transformers.utils.logging.disable_progress_bar()
torch.manual_seed(0)
small = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 1, "num_attention_heads": 2}
Qwen3ForCausalLM(Qwen3Config(vocab_size=64, num_key_value_heads=1, head_dim=32, **small)).save_pretrained("floats")
nf4 = BitsAndBytesConfig(load_in_4bit=True, bnb_4bit_quant_type="nf4")
Qwen3ForCausalLM.from_pretrained("floats", quantization_config=nf4, device_map="cpu").save_pretrained("nf4")

model = Qwen3ForCausalLM.from_pretrained("nf4", device_map="cpu")
model.dequantize()
try:
    model.save_pretrained("refused")
except NotImplementedError:
    print("save_pretrained(): NotImplementedError")
else:
    raise AssertionError("saved")
model.save_pretrained("saved", save_original_format=False)
loaded = Qwen3ForCausalLM.from_pretrained("saved")
weights = [each.model.layers[0].self_attn.q_proj.weight.float() for each in (model, loaded)]
print(f"save_original_format=False: saved, the same weights {torch.equal(*weights)}")
assert torch.equal(*weights)
PYTHON
"$folder/venv/bin/python" -W ignore save.py
