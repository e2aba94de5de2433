# SPDX-License-Identifier: MIT
"""The wire contract: samples and results as named tensors.

Letters: B samples in one request (the batch axis); P frame positions: the first trajectory's frames, then the second's,
then zero padding; K progress bins; D, Dt, H, W as in ``rfm_client.contract.samples``.

Everything that changes the answer is an input. All inputs but five are always present, so that Triton can batch
requests from different callers, with different lengths and sample types. Requests with an optional input share batches
only with each other:

- ``second_frames``, for pairs whose trajectories differ in frame size. ``frames`` then has the first trajectories,
  ``second_frames`` the second, and P counts the positions in both.
- ``frame_digests``, for a model that caches frame features: one digest for each of the P frames. ``frames`` then has
  the pixels that the model may lack, in any order and in any sample's row; zeros may lie between them. The model
  refuses a digest that it does not know, and the caller sends the request again with all pixels.
- ``left_frames`` and ``right_frames``, for a model that reads wrist views: as many frames as ``frames``.
- ``goal``, for such a model: a picture that shows the finished task.
"""

from rfm_client.contract.wire.results import *  # noqa: F403
from rfm_client.contract.wire.samples import *  # noqa: F403
from rfm_client.contract.wire.specs import *  # noqa: F403
