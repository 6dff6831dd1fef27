from ._check import SetupError as SetupError
from ._job import reproduce as reproduce
from ._learned import history as history
from ._learned import initial_states as initial_states
from ._learned import learned_solvers as learned_solvers
from ._learned import train as train
