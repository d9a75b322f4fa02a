"""Perturbations: their draws, and heavier things in MuJoCo."""

import mujoco
import numpy as np
import pytest

from clbench.worlds.camera import VIEW_SIZE
from clbench.worlds.perturbation import MASSES, Perturbation, draw_perturbation, with_mass

XML = """
<mujoco>
  <worldbody>
    <body name="box" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.3" mass="2"/>
      <body name="lid" pos="0 0 0.4">
        <joint type="hinge"/>
        <geom type="box" size="0.1 0.1 0.1" mass="1"/>
      </body>
    </body>
    <body name="ball">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.1" mass="3"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" gear="6"/></actuator>
  <equality><weld body1="box" body2="world"/></equality>
</mujoco>
"""
DERIVED = ("body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0", "actuator_acc0")


def test_a_perturbation_follows_from_the_seed_alone_and_never_changes() -> None:
    # published records may have these episodes: a change of this line makes them false
    drawn = draw_perturbation(7)
    assert drawn == draw_perturbation(7) != draw_perturbation(8)
    start = (0.2693702600102559, 0.4668422362346363, -0.3841252256565115)
    view = (0.7447663944902996, -0.29620558239074124, -0.6648929182898105, -0.2283548940515543)
    assert drawn == Perturbation(0.5, start, view)


def test_a_thing_is_half_or_twice_as_heavy() -> None:
    assert {draw_perturbation(seed).mass for seed in range(20)} == {0.5, 2.0}


def test_all_masses_and_all_sides_are_drawn() -> None:
    drawn = [draw_perturbation(seed) for seed in range(400)]
    shares = [sum(one.mass == mass for one in drawn) / 400 for mass in MASSES]
    assert shares == pytest.approx([1 / len(MASSES)] * len(MASSES), abs=0.1)
    shares_drawn = np.array([[*one.start, *one.view] for one in drawn])
    assert shares_drawn.shape == (400, 3 + VIEW_SIZE)
    assert (np.abs(shares_drawn) <= 1).all()
    np.testing.assert_allclose(shares_drawn.mean(axis=0), 0, atol=0.1)
    np.testing.assert_allclose(np.abs(shares_drawn).mean(axis=0), 0.5, atol=0.1)


def test_a_heavier_thing_is_as_much_harder_to_turn_and_to_push_and_nothing_else_changes() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    before = {
        name: getattr(model, name).copy() for name in ("body_mass", "body_inertia", *DERIVED, "eq_data")
    }
    ball = model.body("ball").id
    heavier = with_mass(model, [ball], 2.0)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(model, name), value)
    others = [number for number in range(model.nbody) if number != ball]
    for name in ("body_mass", "body_inertia"):
        np.testing.assert_array_equal(getattr(heavier, name)[ball], 2 * before[name][ball])
        np.testing.assert_array_equal(getattr(heavier, name)[others], before[name][others])
    np.testing.assert_allclose(heavier.actuator_acc0, before["actuator_acc0"] / 2)
    np.testing.assert_allclose(heavier.body_subtreemass[0], before["body_subtreemass"][0] + 3)
    np.testing.assert_array_equal(heavier.eq_data, before["eq_data"])
    speeds = []
    for one in (model, heavier):
        data = mujoco.MjData(one)
        data.ctrl[:] = 1.0
        mujoco.mj_step(one, data)
        speeds.append(data.joint("x").qvel[0])
    assert speeds[1] == pytest.approx(speeds[0] / 2)


def test_values_that_mujoco_derives_from_masses_equal_those_from_a_heavier_description() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    lighter_lid = XML.replace('mass="1"', 'mass="0.5"')
    described = mujoco.MjModel.from_xml_string(lighter_lid.replace('mass="2"', 'mass="1"'))
    lighter = with_mass(model, [model.body("box").id, model.body("lid").id], 0.5)
    for name in ("body_mass", "body_inertia", *DERIVED):
        np.testing.assert_allclose(getattr(lighter, name), getattr(described, name), rtol=1e-12)


def test_the_same_mass_changes_no_bit() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    same = with_mass(model, [model.body("ball").id], 1.0)
    for name in ("body_mass", "body_inertia", *DERIVED, "eq_data", "qpos0"):
        np.testing.assert_array_equal(getattr(same, name), getattr(model, name))
