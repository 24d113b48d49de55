"""An environment's task, baselines and tuned values as one object."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ..envs.contract.task import Task
from ..envs.engine.catalogue import import_task, importable_name, nearest, short_name, task_class
from ..evaluation.running.evaluate import OPTIONS, Experiment, run_experiment
from ..evaluation.running.parallel import Workers
from ..evaluation.running.rollout import Progress
from .catalogue import baselines_of, package_of
from .table import Baselines
from .tuned_values import TunedValues, table_path

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class Problem:
    """An environment: its task, baselines and tuned values. It is pickled by name."""

    task: type[Task]
    baselines: Baselines
    shipped: ModuleType | None = None
    """Package of its baselines; None of a user's environment."""

    @classmethod
    def of(cls, task: type[Task]) -> "Problem":
        """Return the problem of a task's class, with its registered baselines."""
        return cls(task, baselines_of(task.id), package_of(task.id))

    def __reduce__(self) -> tuple[Any, ...]:
        return problem_of, (self.name,)

    @property
    def id(self) -> str:
        """Gymnasium id."""
        return self.task.id

    @property
    def name(self) -> str:
        """Id by which another process imports the environment: its Gymnasium id, with ``module:`` before a
        user's own.
        """
        return importable_name(self.task)

    @property
    def is_shipped(self) -> bool:
        """Whether this package contains the environment."""
        return self.name == self.id

    @property
    def short_name(self) -> str:
        """Id without namespace, for files and tables."""
        return short_name(self.id)

    @property
    def paper(self) -> str:
        """Name of the policy that is the paper's algorithm; raise ValueError without one."""
        if not self.baselines.score_paper:
            raise ValueError(
                f"{self.id} has no paper's algorithm to compare with: register it with baselines whose "
                "score_paper names one"
            )
        return self.baselines.score_paper

    def paper_among(self, competitors: Mapping[str, Any]) -> str:
        """Return the paper's algorithm among competitors, or else its usual name; empty if there is none.

        Args:
            competitors: makers by name; a stronger reading of the paper among them comes first.
        """
        known = self.baselines
        for reading in filter(None, (known.stronger_paper, known.score_paper)):
            paper = self.find(reading)
            for name, maker in competitors.items():
                if name == reading or maker is paper:
                    return name
        return known.score_paper

    @property
    def knows(self) -> dict[str, str]:
        """What each reference and bound knows beyond the measurements, as text by name."""
        makers = {**self.baselines.references, **self.baselines.bounds}
        return {name: maker.knows for name, maker in makers.items()}

    @property
    def tuned_values(self) -> TunedValues:
        """Stored tuned values of its policies and estimators."""
        shipped = [] if self.shipped is None else [files(self.shipped) / "tuned.json"]
        return TunedValues(self.id, self.baselines.tunable, [table_path(self.id), *shipped])

    @property
    def tuned_policies(self) -> list[str]:
        """Names ``NAME-tuned`` of policies and estimators with stored tuned values."""
        return self.tuned_values.names()

    @property
    def names(self) -> list[str]:
        """Names of its policies, estimators, smoothers, references and bounds, and of tuned ones."""
        return [*self.baselines.names, *self.tuned_policies]

    def find(self, name: str) -> Any:
        """Return the maker of a competitor of this name; None for an unknown name."""
        known = self.baselines
        for table in (known.policies, known.estimators, known.smoothers, known.references, known.bounds):
            if name in table:
                return table[name]
        if name.endswith("-tuned") and name in self.tuned_policies:
            return self.tuned_values.competitor(name.removesuffix("-tuned"))
        return None

    def competitor(self, name: str) -> Any:
        """Return the maker of a competitor of this name; raise ValueError for an unknown name."""
        found = self.find(name)
        if found is None and name.endswith("-tuned"):
            return self.tuned_values.competitor(name.removesuffix("-tuned"))  # raises with the reason
        if found is None:
            raise nearest("policy", name, self.names)
        return found

    def experiment(self, *arguments: Any, **fields: Any) -> Experiment:
        """Make an :class:`.evaluate.Experiment` in this environment, with its paper's algorithm and
        reference.
        """
        known = self.baselines
        experiment = Experiment(self.task, *arguments, **fields)
        return replace(experiment, paper=known.score_paper, reference=known.score_reference)

    def evaluate(
        self,
        competitors: Mapping[str, Any],
        *arguments: Any,
        progress: Progress | None = None,
        workers: Workers | None = None,
        **keywords: Any,
    ) -> "xarray.Dataset":
        """Run competitors over the same episodes of this environment; return the dataset of the evaluation.

        Args:
            competitors: makers by name.
            *arguments: arguments of :meth:`experiment`.
            progress: function called with the number of measurements done.
            workers: processes for the work.
            **keywords: fields of :meth:`experiment` that :data:`.evaluate.OPTIONS` names, and parameters of
                the task.
        """
        options = {name: keywords.pop(name) for name in OPTIONS if name in keywords}
        experiment = self.experiment(*arguments, **options, keywords=keywords)
        experiment = replace(experiment, paper=self.paper_among(competitors))
        return run_experiment(experiment, competitors, progress, workers)


def problem_of(id: str) -> Problem:
    """Return the problem of a registered environment's id."""
    return Problem.of(task_class(id))


def import_problem(id: str) -> Problem:
    """Return the problem of an id; ``module:id`` imports the module first."""
    return Problem.of(import_task(id))
