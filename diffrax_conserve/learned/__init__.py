"""Networks, their training and their files, and the options of the solvers that step with them."""

from . import paper as paper
from ._flow_map_benchmark import Comparison as Comparison
from ._flow_map_benchmark import compare as compare
from ._networks.domain import Box as Box
from ._networks.domain import Frame as Frame
from ._networks.flow_map import AbstractFlowMap as AbstractFlowMap
from ._networks.layer import ConservativeLayer as ConservativeLayer
from ._networks.taylor import Taylor as Taylor
from ._networks.wrappers import BoxCox as BoxCox
from ._networks.wrappers import Repeated as Repeated
from ._networks.wrappers import Transformed as Transformed
from ._solvers.policies import steps_outside as steps_outside
from ._training.data import reachable_states as reachable_states
from ._training.data import trajectories as trajectories
from ._training.loop import FitLog as FitLog
from ._training.recipe import Recipe as Recipe
from ._training.recipe import second_order as second_order
