"""Makes your filter a program that competes: copy this file beside it. It needs only Python.

filtergym evaluate filtergym/ManeuveringTarget-v0 --policy "exec:python my_filter.py" --policy imm
"""

import json
import sys


def serve(begin):
    """Write the estimates of some tracks until their measurements end.

    Args:
        begin: called for each track with the hello and with its initial estimate; returns what is called with each of
            its measurements and returns mean and covariance. Fields come by their names, None where nothing was received.
    """
    answers, sys.stdout = sys.stdout, sys.stderr  # the filter's own prints are no estimates
    hello = json.loads(sys.stdin.readline())
    print(json.dumps({"filtergym": 1, "format": "json"}), file=answers, flush=True)
    tracks = [begin(hello, initial) for initial in split(sys.stdin.readline(), "initial")]
    for line in sys.stdin:
        found = [track(own) for track, own in zip(tracks, split(line, "measurement"))]
        mean, covariance = zip(*found)
        answer = json.dumps({"mean": mean, "covariance": covariance}, default=lambda array: array.tolist())
        print(answer, file=answers, flush=True)


def split(line, name):
    """Fields of each track, of a message."""
    fields = json.loads(line)[name]
    return [dict(zip(fields, values)) for values in zip(*fields.values())]
