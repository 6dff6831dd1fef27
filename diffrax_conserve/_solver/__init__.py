from ._manifold_projection import ManifoldProjection as ManifoldProjection
from ._rk4 import RK4 as RK4
