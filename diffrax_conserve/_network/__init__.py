from ._deeponet import DeepONet as DeepONet
from ._domain import Box as Box
from ._layer import ConservativeLayer as ConservativeLayer
from ._mlp import MLP as MLP
from ._mlp import activation_name as activation_name
from ._pinn import PINN as PINN
