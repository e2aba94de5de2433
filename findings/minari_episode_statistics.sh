#!/bin/sh
# Minari's DataCollector with record_infos=True fails at the end of the first episode if the environment is in
# Gymnasium's own RecordEpisodeStatistics, which adds "episode" to the last info: Minari wants the same keys in the info
# of each step. The episode is lost, since the error is raised by its last step.
#
# Seen with minari 0.5.4 and gymnasium 1.4.0, Python 3.11, CartPole.
# Needs Python 3.10 or newer and the package index. Ends with status 1 if the behaviour changes.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check "minari[create,hdf5]==0.5.4" gymnasium==1.4.0 \
  pillow==12.3.0
cd "$folder"
cat > collect.py <<'PYTHON'
import gymnasium
from gymnasium.wrappers import RecordEpisodeStatistics
from minari import DataCollector

STEPS = 5


def failed_at(env, **options):
    """The step that raises, or None."""
    collector = DataCollector(env, **options)
    collector.reset(seed=0)
    for step in range(1, STEPS + 1):
        try:
            *_, truncated, _ = collector.step(step % 2)
        except ValueError as error:
            print(f"step {step}: {str(error).splitlines()[0]}")
            return step
    assert truncated
    return None


def env():
    return gymnasium.make("CartPole-v1", max_episode_steps=STEPS)


assert failed_at(env(), record_infos=True) is None
assert failed_at(RecordEpisodeStatistics(env()), record_infos=False) is None
assert failed_at(RecordEpisodeStatistics(env()), record_infos=True) == STEPS
PYTHON
"$folder/venv/bin/python" -W ignore collect.py
