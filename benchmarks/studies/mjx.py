"""A four-bar linkage as a model of MuJoCo, whose loop is closed exactly by a projection.

MuJoCo opens a loop into a tree and closes it by a soft constraint. Here the tree alone is the model
of MJX, `tangent` adds the forces that close it, and a projection keeps it closed. The linkage is a
parallelogram, so its angle is that of a pendulum, which is the reference.

Run: `python benchmarks/studies/mjx.py` (four minutes, nearly all of it compilation; needs the extra
`gallery`).
"""

import diffrax
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from scipy.integrate import solve_ivp

import diffrax_conserve as dfc

jax.config.update("jax_enable_x64", True)

TREE = """
<mujoco>
  <option timestep="0.002" integrator="RK4"/>
  <default>
    <geom type="capsule" size="0.02" contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 1 0"/>
  </default>
  <worldbody>
    <body><joint/><geom fromto="0 0 0 0 0 -1" mass="1"/>
      <body name="coupler" pos="0 0 -1">
        <joint/><geom fromto="0 0 0 2 0 0" mass="2"/><site name="tip" pos="2 0 0"/>
      </body>
    </body>
    <body name="rocker" pos="2 0 0">
      <joint/><geom fromto="0 0 0 0 0 -1" mass="1"/><site name="end" pos="0 0 -1"/>
    </body>
  </worldbody>
  LOOP
</mujoco>
"""
LOOP = '<equality><connect site1="tip" site2="end"/></equality>'
START = np.array([1.0, -1.0, 1.0])
TIMES = np.linspace(0, 10, 101)

model = mjx.put_model(mujoco.MjModel.from_xml_string(TREE.replace("LOOP", "")))
data = mjx.make_data(model)


def free(t, y, args):
    """The tree, without the loop."""
    q, v = y
    return v, mjx.forward(model, data.replace(qpos=q, qvel=v)).qacc


def gap(t, y, args):
    """In the plane; the third component vanishes always."""
    tip, end = mjx.kinematics(model, data.replace(qpos=y[0])).site_xpos
    return (tip - end)[jnp.array([0, 2])]


def masses(t, y, args):
    placed = mjx.com_pos(model, mjx.kinematics(model, data.replace(qpos=y[0])))
    return jnp.inf, mjx.full_m(model, mjx.crb(model, placed))


def projected():
    closed = dfc.Constraint(gap)
    rates = closed.derivative(free)
    field = dfc.tangent(free, rates, metric=masses)
    manifold = {"closed": closed, "rates": rates}
    within = dfc.SimplifiedNewton(atol=1e-13)
    solver = dfc.ManifoldProjection(diffrax.Tsit5(), manifold, projection=within)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver, 0.0, 10.0, 0.02, (jnp.array(START), jnp.zeros(3)),
        saveat=diffrax.SaveAt(ts=TIMES), max_steps=501,
    )  # fmt: skip
    gaps = jax.vmap(lambda q: gap(0.0, (q,), None))(solution.ys[0])
    return solution.ys[0][:, 0], jnp.max(jnp.linalg.norm(gaps, axis=1))


def soft():
    """MuJoCo itself, by its method of Runge and Kutta in steps of 2 ms."""
    loop = mujoco.MjModel.from_xml_string(TREE.replace("LOOP", LOOP))
    state = mujoco.MjData(loop)
    state.qpos[:] = START
    angles, gaps = [], []
    for _ in range(len(TIMES)):
        angles.append(state.qpos[0])
        for _ in range(50):
            mujoco.mj_step(loop, state)
            gaps.append(np.linalg.norm(state.site_xpos[0] - state.site_xpos[1]))
    return np.array(angles), max(gaps)


def exact():
    """All three angles are one up to signs, and the weights are those of two rods and a coupler."""
    along = np.array([1.0, -1.0, 1.0])
    inertia = along @ np.asarray(masses(0.0, (jnp.zeros(3),), None)[1]) @ along
    weight = 9.81 * (1 / 2 + 1 / 2 + 2)
    pendulum = lambda t, z: [z[1], -weight / inertia * np.sin(z[0])]  # noqa: E731
    return solve_ivp(pendulum, (0, 10), [1.0, 0.0], "DOP853", TIMES, rtol=1e-12, atol=1e-12).y[0]


if __name__ == "__main__":
    truth = exact()
    for name, run in {"MuJoCo": soft, "projected": projected}.items():
        angle, apart = run()
        error = np.max(np.abs(np.asarray(angle) - truth))
        print(f"{name:9} gap {apart:.0e} m, angle off by {error:.0e}", flush=True)
    if apart > 1e-13 or error > 1e-6:
        raise SystemExit("The projected linkage is off.")
