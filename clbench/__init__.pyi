from . import metrics as metrics
from .base.cache import CacheError as CacheError
from .base.errors import ClbenchError as ClbenchError
from .base.errors import InputError as InputError
from .base.errors import MissingPackageError as MissingPackageError
from .base.errors import NoRecordsError as NoRecordsError
from .base.errors import UnknownNameError as UnknownNameError
from .base.errors import WrongTypeError as WrongTypeError
from .base.lease import LeaseLostError as LeaseLostError
from .data.access import LeakError as LeakError
from .data.questions import QuestionKind as QuestionKind
from .evaluation.episodes import Episode as Episode
from .evaluation.rollouts import Evaluator as Evaluator
from .exchange.demonstrations import export_demonstrations as export_demonstrations
from .exchange.demonstrations import import_demonstrations as import_demonstrations
from .exchange.frames import load_records as load_records
from .jobs.grid import RunsFailedError as RunsFailedError
from .jobs.grid import run as run
from .leaderboard import plot as plot  # type: ignore[import-not-found]  # in a checkout it is elsewhere
from .leaderboard.comparison import compare as compare  # type: ignore[import-not-found]
from .leaderboard.table import load_board as load_board  # type: ignore[import-not-found]
from .learning.method import Metadata as Metadata
from .learning.method import Method as Method
from .learning.method import Progress as Progress
from .learning.method import Stage as Stage
from .learning.prior import MissingDataError as MissingDataError
from .learning.prior import Prior as Prior
from .learning.prior import Source as Source
from .learning.prior import UndeclaredAccessError as UndeclaredAccessError
from .learning.prior import Uses as Uses
from .learning.registry import load_method as load_method
from .learning.registry import method_names as method_names
from .policy.batch import Batch as Batch
from .policy.batch import QuestionBatch as QuestionBatch
from .policy.checkpoint import CheckpointError as CheckpointError
from .policy.policy import Policy as Policy
from .policy.policy import PolicyConfig as PolicyConfig
from .records.reader import RecordError as RecordError
from .records.reader import read_record as read_record
from .records.record import Record as Record
from .runs.agents import evaluate_agent as evaluate_agent
from .runs.agents import next_stage as next_stage
from .runs.run import execute as execute
from .runs.spec import RunSpec as RunSpec
from .runs.stages import MachineError as MachineError
from .spec.budget import Budget as Budget
from .spec.identifiers import scenario_ids as scenario_ids
from .spec.registry import load_scenario as load_scenario
from .spec.registry import register as register
from .spec.scenario import Scenario as Scenario
from .spec.task import Task as Task
from .worlds.gl_backend import RenderingError as RenderingError
from .worlds.scenario_env import ScenarioEnv as ScenarioEnv

__all__: list[str]
__version__: str
