"""A folder that a model hub takes as it is: an agent's arrays, and a card that says what it is and how good.

The card is Markdown with metadata in the form of the Hugging Face hub's model cards (``model-index`` holds the
results), written as JSON, which YAML includes. Nothing is uploaded from here.
"""

import json
import shutil
from pathlib import Path

from ..baselines.problem import Problem
from ..evaluation.files import whole_files
from ..evaluation.metrics import mean_cost
from .learned_policy import load_policy, read_header


def write_hub_folder(problem: Problem, agent: Path, folder: Path, episodes: int = 200) -> None:
    """Write ``README.md``, ``model.safetensors`` and ``config.json`` of an agent into a folder.

    The agent is evaluated beside the paper's algorithm, on the test split of its training distribution.

    Args:
        problem: that the agent was trained for.
        agent: file of plain arrays, as ``filtergym export`` writes it.
        folder: where the files are put; those of these names are replaced.
        episodes: of the evaluation.

    Raises:
        ValueError: if the file is no agent of this environment, or the folder cannot be written to.
    """
    policy, header = load_policy(problem.task, agent), read_header(agent)
    run, paper = header["run"], problem.baselines.score_paper
    results = problem.evaluate({"agent": policy, paper: problem.competitor(paper)}, None, episodes)
    own, others = (mean_cost(results, each).mean() for each in ("agent", paper))
    name = f"{problem.short_name}-{run.get('algorithm', 'agent')}"
    relative = round(float(100.0 * (own / others - 1.0)), 2)
    metric = {"type": "relative_cost", "name": f"cost against {paper}, %", "value": relative}
    metadata = {
        "library_name": "filtergym",
        "license": "mit",
        "tags": ["reinforcement-learning", "adaptive-filter", problem.id],
        "model-index": [
            {
                "name": name,
                "results": [
                    {
                        "task": {"type": "reinforcement-learning", "name": "adaptive filtering"},
                        "dataset": {"type": problem.id, "name": problem.id},
                        "metrics": [metric],
                    }
                ],
            }
        ],
    }
    card = f"""---
{json.dumps(metadata, indent=1)}
---

# {name}

An agent that steers the filter of `{problem.id}` under control `{header["control"]}`, as plain
arrays: it needs NumPy, and loading it executes nothing.

```sh
filtergym evaluate {problem.id} --policy model.safetensors --policy {paper}
```

* Cost against `{paper}`: {relative:+.1f} %, {episodes} episodes of `{problem.task.default_scenario}`, test split.
* Training: `{run.get("command", "not told")}`
* Arrays `envelope_low` and `envelope_high`: what it was shown in training. Do not trust it outside of that.
"""
    config = {
        key: header[key] for key in ("environment", "control", "interface", "fields", "output", "activation")
    }
    with whole_files(folder) as waiting:
        (waiting / "README.md").write_text(card, encoding="utf-8")
        (waiting / "config.json").write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")
        shutil.copyfile(agent, waiting / "model.safetensors")
