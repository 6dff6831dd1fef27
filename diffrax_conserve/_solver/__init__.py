from ._count_rejections import CountRejections as CountRejections
from ._deeponet import DeepONetSolver as DeepONetSolver
from ._manifold_projection import ManifoldProjection as ManifoldProjection
from ._pinn import PINNSolver as PINNSolver
from ._random_features import RandomFeatureSolver as RandomFeatureSolver
from ._rk4 import RK4 as RK4
from ._statistics import ProjectionStatistics as ProjectionStatistics
from ._statistics import statistics as statistics
