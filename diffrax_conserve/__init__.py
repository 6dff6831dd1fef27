from . import systems as systems
from ._check import InvarianceEntry as InvarianceEntry
from ._check import InvarianceReport as InvarianceReport
from ._check import check_invariance as check_invariance
from ._diagnostics import drift as drift
from ._manifold import Constraint as Constraint
from ._manifold import FirstIntegral as FirstIntegral
from ._projection import AbstractProjection as AbstractProjection
from ._projection import ClosedForm as ClosedForm
from ._projection import Failure as Failure
from ._projection import Newton as Newton
from ._projection import Problem as Problem
from ._projection import ProjectionInfo as ProjectionInfo
from ._projection import SimplifiedNewton as SimplifiedNewton
from ._projection import project as project
from ._solver import RK4 as RK4
from ._solver import CountRejections as CountRejections
from ._solver import ManifoldProjection as ManifoldProjection
from ._solver import ProjectionStatistics as ProjectionStatistics
from ._solver import statistics as statistics

__version__ = "0.1.0"
