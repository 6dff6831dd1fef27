from ._command import main as main
from ._command import run as run
from ._job import SetupError as SetupError
from ._job import reproduce as reproduce
from ._trained import history as history
from ._trained import initial_states as initial_states
from ._trained import learned_solvers as learned_solvers
from ._trained import train as train
