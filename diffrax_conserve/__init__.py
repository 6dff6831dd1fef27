"""Keep any diffrax solve exactly on the manifold that its physics prescribes.

Define the conserved quantities, wrap the solver, and use `diffrax.diffeqsolve` as usual:

    import diffrax, diffrax_conserve as dfc, jax.numpy as jnp

    energy = dfc.FirstIntegral(lambda t, y, args: y[1] ** 2 / 2 - jnp.cos(y[0]))
    term = diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -jnp.sin(y[0])]))
    solver = dfc.ManifoldProjection(diffrax.Tsit5(), energy)
    solution = diffrax.diffeqsolve(term, solver, 0, 10, 0.1, jnp.array([1.0, 0.0]))

What is conserved    FirstIntegral, Constraint, find_invariants
Diagnostics          check_invariance, compare, drift, off_manifold, statistics
Solvers              ManifoldProjection, RK4, Unrolled
Symmetric solvers    SymmetricProjection, ImplicitMidpoint, RATTLE
Stiff, algebraic     Radau, DAE
Projections          SimplifiedNewton, Newton, AlongLine, Staged, project
Formulas             ClosedForm, closed_forms
Learned solvers      PINNSolver, DeepONetSolver, RandomFeatureSolver, fit, load_pretrained, learned
Systems              systems.get("kepler"), systems.names()
Your own tests       import diffrax_conserve.testing

A projection that fails is never reported as a success. Keeping the energy does not make a solution
accurate: measure its error too.
"""

from . import learned as learned
from . import systems as systems
from ._dae.dae import DAE as DAE
from ._dae.radau import Radau as Radau
from ._diagnostics.check_invariance import check_invariance as check_invariance
from ._diagnostics.compare import compare as compare
from ._diagnostics.comparison import ComparisonReport as ComparisonReport
from ._diagnostics.comparison import ComparisonRow as ComparisonRow
from ._diagnostics.drift import drift as drift
from ._diagnostics.drift import off_manifold as off_manifold
from ._diagnostics.find_invariants import find_invariants as find_invariants
from ._manifold import Constraint as Constraint
from ._manifold import FirstIntegral as FirstIntegral
from ._mechanics.implicit_midpoint import ImplicitMidpoint as ImplicitMidpoint
from ._mechanics.rattle import RATTLE as RATTLE
from ._mechanics.symmetric_projection import SymmetricProjection as SymmetricProjection
from ._numerics.problem import Problem as Problem
from ._numerics.problem import Step as Step
from ._projection import closed_forms as closed_forms
from ._projection.along_line import AlongLine as AlongLine
from ._projection.base import AbstractProjection as AbstractProjection
from ._projection.clipped import clipped as clipped
from ._projection.closed_form import ClosedForm as ClosedForm
from ._projection.newton import Newton as Newton
from ._projection.project import project as project
from ._projection.simplified_newton import SimplifiedNewton as SimplifiedNewton
from ._projection.staged import Staged as Staged
from ._projection.tangent import tangent as tangent
from ._solver.manifold_projection import ManifoldProjection as ManifoldProjection
from ._solver.statistics import statistics as statistics
from ._solver.unrolled import RK4 as RK4
from ._solver.unrolled import Unrolled as Unrolled
from .learned._files import load as load
from .learned._files import load_pretrained as load_pretrained
from .learned._files import save as save
from .learned._networks.deeponet import DeepONet as DeepONet
from .learned._networks.pinn import PINN as PINN
from .learned._solvers.flow_map_solver import DeepONetSolver as DeepONetSolver
from .learned._solvers.pinn_solver import PINNSolver as PINNSolver
from .learned._solvers.random_features import RandomFeatureSolver as RandomFeatureSolver
from .learned._training.fit import fit as fit

__version__ = "0.2.0"
