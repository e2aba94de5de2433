# SPDX-License-Identifier: MIT
"""Reward models for robot learning, served by Triton: checkpoints, models, collation, engine."""
