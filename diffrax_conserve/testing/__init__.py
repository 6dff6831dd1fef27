import importlib.util as _util

if _util.find_spec("hypothesis") is None:
    raise ImportError(
        "diffrax_conserve.testing needs hypothesis: pip install '.[testing]' in the folder of "
        "diffrax-conserve"
    )

from ._conserved import assert_conserved as assert_conserved
from ._conserved import assert_on_manifold as assert_on_manifold
from ._gradients import assert_gradients as assert_gradients
from ._order import assert_order as assert_order
from ._states import catalogue_systems as catalogue_systems
from ._states import states as states
from ._states import step_sizes as step_sizes
from ._states import system_states as system_states
from ._states import times as times
