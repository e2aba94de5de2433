#!/bin/sh
# Triton's metrics count requests to an ensemble under version 1, whatever version serves: after a rollout to version 2,
# dashboards show an ensemble whose version 2 answers nothing. A request that fails in a step counts twice for the
# ensemble, under versions 1 and 2, and as a success for the Python model that answered it with an error.
#
# Seen with Triton 2.51.0 (nvidia-pytriton 0.7.0), numpy 1.26.4, Python 3.11: two requests to an ensemble that has
# version 2 alone, around a Python model that has version 2 alone; the model answers the second one with an error.
# Needs Python 3.11 with its shared library, and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
mkdir -p models/step/2 models/whole/2 backends/python
cat > models/step/2/model.py <<'PYTHON'
import triton_python_backend_utils as pb_utils


class TritonPythonModel:
    def execute(self, requests):
        return [self._answer(pb_utils.get_input_tensor_by_name(request, "IN").as_numpy()) for request in requests]

    def _answer(self, values):
        if values[0] < 0:
            return pb_utils.InferenceResponse(error=pb_utils.TritonError("expected a positive number"))
        return pb_utils.InferenceResponse([pb_utils.Tensor("OUT", values)])
PYTHON
tensors='input [{ name: "IN" data_type: TYPE_FP32 dims: [1] }] output [{ name: "OUT" data_type: TYPE_FP32 dims: [1] }]
version_policy { specific { versions: [2] } }'
echo "backend: \"python\" instance_group [{ kind: KIND_CPU }] $tensors" > models/step/config.pbtxt
echo "platform: \"ensemble\" ensemble_scheduling { step [{ model_name: \"step\" model_version: -1
  input_map { key: \"IN\" value: \"IN\" } output_map { key: \"OUT\" value: \"OUT\" } }] } $tensors" > models/whole/config.pbtxt
cat > ask.py <<'PYTHON'
import json
import os
import re
import socket
import subprocess
import sys
import sysconfig
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytriton

EXPECTED = {
    ("success", "step", "2"): 2, ("success", "whole", "1"): 1,
    ("failure", "whole", "1"): 1, ("failure", "whole", "2"): 1,
}
wheel = Path(pytriton.__file__).parent / "tritonserver"
stub = wheel / "python_backend_stubs" / f"{sys.version_info.major}.{sys.version_info.minor}"
for file in (*(wheel / "backends" / "python").iterdir(), *stub.iterdir()):
    link = Path("backends", "python", file.name)
    if not link.is_symlink():
        link.symlink_to(file)
libraries = [wheel.parents[1] / "nvidia_pytriton.libs", sysconfig.get_config_var("LIBDIR")]
environment = {
    **os.environ,
    "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
    "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
}
words = [f"--model-repository={Path('models').resolve()}", f"--backend-directory={Path('backends').resolve()}"]
with socket.create_server(("127.0.0.1", 0)) as first, socket.create_server(("127.0.0.1", 0)) as second:
    port, metrics_port = first.getsockname()[1], second.getsockname()[1]
local = ["--http-address=127.0.0.1", "--metrics-address=127.0.0.1", "--allow-grpc=false"]
ports = [f"--http-port={port}", f"--metrics-port={metrics_port}", *local]
log = open("triton.log", "wb")
server = subprocess.Popen([wheel / "bin" / "tritonserver", *words, *ports], env=environment, stdout=log, stderr=log)


def get(url, body=None):
    headers = {"Content-Type": "application/json"}
    with urllib.request.urlopen(urllib.request.Request(url, body, headers), timeout=10) as answer:
        return answer.read().decode()


try:
    for _ in range(120):
        try:
            get(f"http://127.0.0.1:{port}/v2/health/ready")
            break
        except OSError:
            time.sleep(0.5)
    for value in (1.0, -1.0):
        asked = {"inputs": [{"name": "IN", "shape": [1], "datatype": "FP32", "data": [value]}]}
        try:
            answer = json.loads(get(f"http://127.0.0.1:{port}/v2/models/whole/infer", json.dumps(asked).encode()))
            print("answered by version", answer["model_version"])
        except urllib.error.HTTPError as error:
            print(error.read().decode())
    time.sleep(1)
    lines = get(f"http://127.0.0.1:{metrics_port}/metrics")
finally:
    server.terminate()
    server.wait()
counts = {}
for kind, labels, value in re.findall(r"^nv_inference_request_(success|failure)\{(.*)\} (\S+)$", lines, re.MULTILINE):
    named = dict(re.findall(r'(\w+)="([^"]*)"', labels))
    if float(value):
        key = (kind, named["model"], named["version"])
        counts[key] = counts.get(key, 0) + int(float(value))
for key, count in sorted(counts.items()):
    print(*key, count)
sys.exit(counts != EXPECTED)
PYTHON
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check nvidia-pytriton==0.7.0 numpy==1.26.4
venv/bin/python ask.py
