# SPDX-License-Identifier: MIT
"""What runs beside Triton, which ``rfm.launch`` has started: watches it, and heals what it does not heal itself.

- Watch: ``triton_watch`` (does Triton answer, what does it serve?), ``model_processes`` (do they live, and get on?),
  ``model_probe`` (does a model answer?).
- Heal: ``model_states`` is the table of states, events and actions of a model; ``model_watch`` feeds it and acts;
  ``model_reload`` unloads and loads; ``back_off`` chooses the pauses between starts.
- Together: ``served_models`` holds all models of one Triton, ``supervisor`` Triton itself and the ``gateway_process``;
  ``status`` is what others see of it. They are one thread; what may wait runs ``background`` calls.
"""
