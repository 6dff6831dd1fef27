"""Attack: adaptive solves whose projection becomes hopeless, with `max_steps=None` too.

They are to end in a failure whose entry is `alpha`, at most 150 steps after the hopeless time. A
solve that never ends is killed by the runner, and found wrong.
"""

import functools
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_conserve as dfc

from .oracle import Tally, is_told, log_uniform

LANES, TIMEOUT = 10, 60
T1, MORE = 6.0, 150


def energy(t: Any, y: Any, args: Any) -> Any:
    """Of a pendulum: it is nowhere below -1."""
    return 0.5 * y[1] ** 2 - jnp.cos(y[0])


def later(t: Any, args: Any, before: Any, after: Any) -> Any:
    return jnp.where(t > args[0], after, before)


ALPHAS = {
    "unreachable value": dfc.FirstIntegral(energy, value=-5.0),
    "unreachable square": dfc.FirstIntegral(lambda t, y, args: jnp.sum(y**4), value=-1.0),
    "NaN at the start": dfc.FirstIntegral(lambda t, y, args: energy(t, y, args) * jnp.nan),
    "infinite at the start": dfc.FirstIntegral(lambda t, y, args: energy(t, y, args) + jnp.inf),
    "NaN later": dfc.FirstIntegral(lambda t, y, a: energy(t, y, a) * later(t, a, 1, jnp.nan)),
    "NaN gradient later": dfc.FirstIntegral(
        lambda t, y, a: energy(t, y, a) + 0 * jnp.sqrt(later(t, a, 1, -1) + 0 * y[0])
    ),
    "jump": dfc.FirstIntegral(lambda t, y, a: energy(t, y, a) + later(t, a, 0, 9)),
    "jump of a constant": dfc.FirstIntegral(lambda t, y, a: later(t, a, 0.0, 1.0) + 0 * y[0]),
    "jump of a constraint": dfc.Constraint(lambda t, y, a: later(t, a, 0.0, 1.0) + 0 * y[0]),
    "runs away": dfc.FirstIntegral(lambda t, y, a: energy(t, y, a) + 10 * jnp.maximum(t - a[0], 0)),
}
AT_START = {k for k in ALPHAS if "start" in k or "unreachable" in k}
# The state first shrinks to the equilibrium like a square root, in many steps that succeed: here
# "steps" are those that are rejected.
SINGULAR = {"runs away"}
SOLVERS = {"Tsit5": dfx.Tsit5(), "Bosh3": dfx.Bosh3(), "Dopri8": dfx.Dopri8(), "Heun": dfx.Heun()}


@functools.cache
def compiled(case: str, solver: str, newton: bool, endless: bool, beside: bool) -> Any:
    projection = dfc.Newton() if newton else dfc.SimplifiedNewton()

    def solve(manifold: Any, t1: Any, y0: Any, args: Any, rtol: Any) -> Any:
        term = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])]))
        wrapped = dfc.ManifoldProjection(SOLVERS[solver], manifold, projection=projection)
        options = dict(saveat=dfx.SaveAt(t1=True, solver_state=True), throw=False)
        options |= dict(max_steps=None if endless else 4096)
        options |= dict(stepsize_controller=dfx.PIDController(rtol, rtol))
        return dfx.diffeqsolve(term, wrapped, 0.0, t1, None, y0, args, **options)

    good = dfc.FirstIntegral(energy)
    # The second constraint contradicts the first, or not.
    manifold = {"alpha": ALPHAS[case]} | ({"good": good} if beside else {})
    kind = "num_rejected_steps" if case in SINGULAR else "num_steps"

    def both(y0: Any, args: Any, rtol: Any) -> Any:
        bad = solve(manifold, T1, y0, args, rtol)
        before = solve({"good": good}, args[0], y0, args, rtol)
        steps = bad.stats[kind], before.stats[kind]
        # Without an end there is nothing to compare with.
        worst = dfc.statistics(bad).worst
        return bad.result, worst, *steps, dfx.is_okay(before.result), bad.ys[-1]

    return eqx.filter_jit(eqx.filter_vmap(both))


def run(seed: int, number: int, lanes: int) -> Tally:
    rng = np.random.default_rng([seed, number])
    cases = list(ALPHAS)
    case, solver = cases[(seed + number) % len(cases)], str(rng.choice(list(SOLVERS)))
    newton, endless, beside = rng.random(3) < (0.25, 0.5, 0.3)
    y0 = rng.uniform(0.3, 1.5, (lanes, 2))
    args = rng.uniform(0.5, 4, (lanes, 1))
    rtol = log_uniform(rng, 1e-8, 1e-3, lanes)
    solve = compiled(case, solver, bool(newton), bool(endless), bool(beside))
    result, *rest = solve(*map(jnp.asarray, (y0, args, rtol)))
    worst, steps, before, ended, y = map(np.asarray, rest)
    okay = np.asarray(result == dfx.RESULTS.successful)
    messages = [dfx.RESULTS[jax.tree.map(lambda x, i=i: x[i], result)] for i in range(lanes)]
    # Of two integrals that contradict each other, either may be named.
    named = (worst == 0) | (beside & (worst == 1))
    unnamed = ~okay & (np.array([not is_told(message) for message in messages]) | ~named)
    if case not in AT_START:
        unnamed &= ended  # otherwise all steps were taken before
    allowed = np.where(case in AT_START, 0, np.where(ended, before, np.inf)) + MORE
    tally = Tally(lanes, int(okay.sum()))

    def show(i: int) -> str:
        what = f"{case}, {solver}, {newton=}, {endless=}, {beside=}, y0 = {y0[i]}, {args[i]}"
        return f"{what}, {rtol[i]=}: {steps[i]} steps ({before[i]}), y = {y[i]}, {messages[i]!r}"

    tally.blame(f"{case}: success", okay, show)
    tally.blame(f"{case}: no name", unnamed, show)
    tally.blame(f"{case}: more than {MORE} more steps", ~okay & (steps > allowed), show)
    return tally
