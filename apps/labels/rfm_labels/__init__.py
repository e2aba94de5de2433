# SPDX-License-Identifier: MIT
"""Label every frame of a dataset, in files that training reads. Needs ``pip install ./client ./apps/labels``.

from rfm_client import RewardClient
from rfm_labels import ClientScorer, LabelOptions, label, open_dataset

with RewardClient("grpc://localhost:8001") as client:
    report = label(open_dataset("my_dataset"), ClientScorer(client), LabelOptions(cameras=("top",)))
"""

from rfm_labels.datasets.dataset import Dataset, DatasetEpisode, iter_episodes
from rfm_labels.datasets.episodes import Episode
from rfm_labels.datasets.faults import DatasetError
from rfm_labels.datasets.opening import open_dataset
from rfm_labels.evaluation import Evaluation, LabelComparison, evaluate_labels
from rfm_labels.label_files import Curve, EpisodeLabels, find_label_files, read_episode_labels, read_provenance
from rfm_labels.labelling import Report, label
from rfm_labels.options import LabelOptions, RayOptions, Watch, parse_episodes
from rfm_labels.outcomes import read_outcomes
from rfm_labels.ray_engine import label_with_ray
from rfm_labels.scorer import CheckpointFacts, ClientScorer, Scorer
from rfm_labels.summary import Summary, summarise

__all__ = [
    "CheckpointFacts",
    "ClientScorer",
    "Curve",
    "Dataset",
    "DatasetEpisode",
    "DatasetError",
    "Episode",
    "EpisodeLabels",
    "Evaluation",
    "LabelComparison",
    "LabelOptions",
    "RayOptions",
    "Report",
    "Scorer",
    "Summary",
    "Watch",
    "evaluate_labels",
    "find_label_files",
    "iter_episodes",
    "label",
    "label_with_ray",
    "open_dataset",
    "parse_episodes",
    "read_episode_labels",
    "read_outcomes",
    "read_provenance",
    "summarise",
]
