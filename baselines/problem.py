"""What belongs to an environment, found once where its id is given and handed down as one object."""

from dataclasses import dataclass, replace
from typing import Any

from ..envs.catalogue import import_task, importable_name, nearest, task_class
from ..envs.task import Task
from ..evaluation.evaluate import Experiment
from .catalogue import baselines_of
from .table import Baselines
from .tuning import tuned_names, tuned_policy


@dataclass(frozen=True)
class Problem:
    """An environment's task, and what it is compared with; to another process it goes by its name."""

    task: type[Task]
    baselines: Baselines

    def __reduce__(self) -> tuple[Any, ...]:
        return problem_of, (self.name,)

    @property
    def id(self) -> str:
        """Gymnasium id."""
        return self.task.id

    @property
    def name(self) -> str:
        """Id by which another process finds it, see :func:`.envs.catalogue.importable_name`."""
        return importable_name(self.task)

    @property
    def tuned(self) -> list[str]:
        """Names of policies with tuned values."""
        return tuned_names(self.id)

    @property
    def names(self) -> list[str]:
        """Names of its policies, estimators, references and bounds, and of policies that were tuned."""
        return [*self.baselines.names, *self.tuned]

    def competitor(self, name: str) -> Any:
        """Return what makes one of its own policies or estimators, tuned or not, references or bounds for a task.

        Raises:
            ValueError: if there is no such name.
        """
        known = self.baselines
        for table in (known.policies, known.estimators, known.references, known.bounds):
            if name in table:
                return table[name]
        if name.endswith("-tuned"):
            return tuned_policy(self.id, name.removesuffix("-tuned"))
        raise nearest("policy", name, self.names)

    def experiment(self, *arguments: Any, **fields: Any) -> Experiment:
        """Return an experiment on it, with the paper's algorithm and the reference of its baselines.

        Args:
            *arguments: what follows the environment in :class:`.evaluation.evaluate.Experiment`.
            **fields: likewise.
        """
        known = self.baselines
        experiment = Experiment(self.name, *arguments, **fields)
        return replace(experiment, paper=known.score_paper, reference=known.score_reference)


def problem_of(id: str) -> Problem:
    """Return the problem of an environment id, and import nothing.

    Raises:
        ValueError: for an unknown environment.
    """
    cls = task_class(id)
    return Problem(cls, baselines_of(cls.id))


def import_problem(id: str) -> Problem:
    """Return the problem of an id that a user has given; ``module:id`` imports the module first.

    Raises:
        ValueError: for an unknown environment, or if its module cannot be imported.
    """
    return problem_of(import_task(id).id)
