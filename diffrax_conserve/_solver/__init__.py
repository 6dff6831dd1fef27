from .count_rejections import CountRejections as CountRejections
from .manifold_projection import ManifoldProjection as ManifoldProjection
from .rk4 import RK4 as RK4
from .statistics import ProjectionStatistics as ProjectionStatistics
from .statistics import statistics as statistics
from .unrolled import Unrolled as Unrolled
