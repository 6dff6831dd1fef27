"""What `print` shows of the records of the package."""

import pydoc

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp

import diffrax_conserve as dfc

SPHERE = dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 1)


def test_the_record_of_a_projection_prints_numbers():
    _, info = dfc.project(SPHERE, jnp.array([1.0, 2.0, 2.0]))
    lines = str(info).splitlines()
    assert lines[0] == "projected"
    assert f"  num_steps        {int(info.num_steps)}" in lines
    assert "  correction       2.0e+00" in lines
    assert "roundoff" in lines[-1]


def test_a_failure_is_printed_as_one():
    apart = (SPHERE, dfc.Constraint(lambda t, y, args: jnp.sum(y**2) - 2))
    _, info = dfc.project(apart, jnp.array([1.0, 2.0, 2.0]))
    assert str(info).startswith("NOT PROJECTED: ")
    assert f"worst            {int(info.worst)}" in str(info)


def test_a_batch_is_printed_by_its_ranges():
    project = jax.jit(jax.vmap(lambda y: dfc.project(SPHERE, y)))
    ys = jnp.array([[2.0, 0.0], [5.0, 0.0], [jnp.nan, 0.0]])
    _, info = project(ys)
    assert str(info).startswith("2 of 3 projections succeeded")
    _, info = project(ys.at[2, 0].set(3.0))
    assert "correction       1.0e+00 to 4.0e+00" in str(info)


def test_statistics_print_numbers():
    sol = eqx.filter_jit(dfx.diffeqsolve)(
        dfx.ODETerm(lambda t, y, args: jnp.array([-y[1], y[0]])),
        dfc.ManifoldProjection(dfc.RK4(), SPHERE),
        t0=0.0,
        t1=1.0,
        dt0=0.125,
        y0=jnp.array([1.0, 0.0]),
        saveat=dfx.SaveAt(t1=True, solver_state=True),
    )
    text = str(dfc.statistics(sol))
    assert text.splitlines()[1] == "  num_projections  8"
    assert "worst" not in text


def test_help_opens_with_an_introduction():
    text = pydoc.plain(pydoc.render_doc(dfc))
    assert "diffrax_conserve - Keep any diffrax solve" in text
    names = [name for name in dfc.__doc__.replace(",", " ").split() if hasattr(dfc, name)]
    assert {"FirstIntegral", "ManifoldProjection", "drift", "project"} <= set(names)
