"""resumed.py N <events.jsonl: whether the learner started N times, and every time but the first from a later epoch than before."""

import json
import sys

epochs = []
for event in map(json.loads, sys.stdin):
    if event["event"] == "started":
        epochs.append(None)
    elif event["event"] == "opened" and epochs[-1] is None:
        epochs[-1] = event["epoch"]
print("==> learners began with the epochs", *epochs)
sys.exit(len(epochs) != int(sys.argv[1]) or epochs[0] != 0 or any(a >= b for a, b in zip(epochs, epochs[1:])))
