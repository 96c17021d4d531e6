"""Runs a policy as TorchScript: export.py MODULE < inputs > outputs, both JSON lists of steps, a step a list of tensors."""

import json
import sys

import torch

policy = torch.jit.load(sys.argv[1])
outputs, state = [], None
for observation, previous_action, first, *start in json.load(sys.stdin):
    tensors = [torch.tensor(x) for x in (observation, previous_action, first)]
    state = [torch.tensor(x) for x in start] if state is None else state
    with torch.no_grad():
        parameters, value, *state = policy(*tensors, *state)
    outputs.append([x.tolist() for x in (parameters, value, *state)])
json.dump(outputs, sys.stdout)
