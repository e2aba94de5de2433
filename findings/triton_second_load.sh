#!/bin/sh
# Loading an ensemble loads its Python models anew, although none has changed: the first load stored bytecode in the
# model's version folder (__pycache__), which counts as a change. A checkpoint of gigabytes is read twice, and the model
# does not answer meanwhile. PYTHONDONTWRITEBYTECODE=1 in Triton's environment does not help: the stub ignores it.
#
# Seen with Triton 2.51.0 (nvidia-pytriton 0.7.0), numpy 1.26.4, Python 3.11, --model-control-mode=explicit: a Python
# model is loaded, then twice an ensemble around it. The model is initialised at the first two loads, not at the third.
# With a file named __pycache__ in the version folder, it is initialised once.
# Needs Python 3.11 with its shared library, and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > model.py <<'PYTHON'
import triton_python_backend_utils as pb_utils


class TritonPythonModel:
    def initialize(self, args):
        with open("initialised.txt", "a") as file:
            print(args["model_name"], file=file)

    def execute(self, requests):
        values = (pb_utils.get_input_tensor_by_name(request, "IN").as_numpy() for request in requests)
        return [pb_utils.InferenceResponse([pb_utils.Tensor("OUT", each)]) for each in values]
PYTHON
tensors='input [{ name: "IN" data_type: TYPE_FP32 dims: [1] }] output [{ name: "OUT" data_type: TYPE_FP32 dims: [1] }]'
mkdir -p backends/python
for name in plain guarded; do
  mkdir -p "models/$name/1" "models/around_$name/1"
  cp model.py "models/$name/1/"
  echo "backend: \"python\" instance_group [{ kind: KIND_CPU }] $tensors" > "models/$name/config.pbtxt"
  echo "platform: \"ensemble\" ensemble_scheduling { step [{ model_name: \"$name\" model_version: -1
    input_map { key: \"IN\" value: \"IN\" } output_map { key: \"OUT\" value: \"OUT\" } }] } $tensors" \
    > "models/around_$name/config.pbtxt"
done
touch models/guarded/1/__pycache__
cat > load.py <<'PYTHON'
import os
import socket
import subprocess
import sys
import sysconfig
import time
import urllib.request
from pathlib import Path

import pytriton

EXPECTED = {"plain": [1, 2, 2], "guarded": [1, 1, 1]}
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
    "PYTHONDONTWRITEBYTECODE": "1",
}
with socket.create_server(("127.0.0.1", 0)) as free:
    url = f"http://127.0.0.1:{free.getsockname()[1]}/v2"
words = [f"--model-repository={Path('models').resolve()}", f"--backend-directory={Path('backends').resolve()}"]
words += ["--model-control-mode=explicit", "--allow-grpc=false", "--allow-metrics=false"]
words += ["--http-address=127.0.0.1", f"--http-port={url.split(':')[2].split('/')[0]}"]
log = open("triton.log", "wb")
server = subprocess.Popen([wheel / "bin" / "tritonserver", *words], env=environment, stdout=log, stderr=log)
counts = {name: [] for name in EXPECTED}
try:
    for _ in range(120):
        try:
            urllib.request.urlopen(f"{url}/health/live", timeout=10).close()
            break
        except OSError:
            time.sleep(0.5)
    for name in EXPECTED:
        for model in (name, f"around_{name}", f"around_{name}"):
            time.sleep(1.1)  # more than a second between changes
            request = urllib.request.Request(f"{url}/repository/models/{model}/load", b"{}")
            urllib.request.urlopen(request, timeout=60).close()
            counts[name].append(Path("initialised.txt").read_text().split().count(name))
            print(f"loaded {model}: {name} was initialised {counts[name][-1]} times")
finally:
    server.terminate()
    server.wait()
sys.exit(counts != EXPECTED)
PYTHON
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check nvidia-pytriton==0.7.0 numpy==1.26.4
venv/bin/python load.py
