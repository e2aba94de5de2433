#!/bin/sh
# A folder with a checkpoint's config.json, but without the tokenizer's files: transformers 4.57.6 raises an error.
# 5.24.0 returns a tokenizer with an empty vocabulary, and logs nothing about it. It writes every word as the unknown
# one, or as nothing: "open the drawer" and "close the door" become the same ids for T5, BERT and Qwen2, so a policy or
# reward model that was copied without these files hears the same instruction always.
#
# Seen with transformers 4.57.6 and 5.24.0, sentencepiece 0.2.1, protobuf 6.33.1, Python 3.11.
# Needs Python 3.10 or newer and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > instructions.py <<'PYTHON'
import json
import sys
from pathlib import Path

import transformers

EXPECTED = {
    "4.57.6": {"t5": "TypeError", "bert": "TypeError", "qwen2": "TypeError"},
    "5.24.0": {"t5": "[3, 2, 3, 2, 3, 2, 1]", "bert": "[2, 1, 1, 1, 3]", "qwen2": "[]"},
}
found = {}
for network in ("t5", "bert", "qwen2"):
    (folder := Path(network)).mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"model_type": network}))
    try:
        tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    except Exception as error:
        found[network] = type(error).__name__
    else:
        first, second = (tokenizer(text).input_ids for text in ("open the drawer", "close the door"))
        found[network] = str(first) if first == second else f"{first}, {second}"
print(f"transformers {transformers.__version__}: {found}")
sys.exit(found != EXPECTED[transformers.__version__])
PYTHON
for version in 4.57.6 5.24.0; do
  python3 -m venv --clear venv
  venv/bin/pip install --quiet --disable-pip-version-check "transformers==$version" sentencepiece==0.2.1 protobuf==6.33.1
  venv/bin/python instructions.py
done
