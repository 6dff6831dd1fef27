from ._base import AbstractProjection as AbstractProjection
from ._base import ProjectionInfo as ProjectionInfo
from ._newton import Newton as Newton
from ._project import apply as apply
from ._project import check_metric as check_metric
from ._project import check_state as check_state
from ._project import project as project
from ._simplified_newton import SimplifiedNewton as SimplifiedNewton
