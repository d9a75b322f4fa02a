"""Names that strangers choose: the allowed ones, and the ones that could be confused."""

import itertools

import pytest

from clbench.spec.identifiers import (
    built_in_methods,
    check_label,
    check_method_name,
    check_plain,
    check_scenario_id,
    folder_name,
    scenario_ids,
)


def test_our_own_names_are_allowed_and_not_alike() -> None:
    for scenario in scenario_ids():
        check_scenario_id(scenario)
    for method in built_in_methods():
        check_method_name(method)
    assert "sft" in built_in_methods()


@pytest.mark.parametrize(
    "method",
    [
        "theirs/sft",
        "their-lab/my_method",
        "lab.tools/v2-x",
        "me/pi0.5",
        "mine:Gentle",
        "a.b_c.d:SFT",
        "Better",
        "sft_2",
    ],
)
def test_names_of_strangers_are_allowed(method: str) -> None:
    check_method_name(method)
    check_label(f"{method}+speed=1e-05+kind=None+layers=[1, 2]+of='a'+rate=-0.5")
    check_label(f"{method}+scale=1e+20")


@pytest.mark.parametrize("scenario", ["theirs/Toy-v0", "my-lab/Reach.Far-v12", "x/y-v0"])
def test_scenarios_of_strangers_are_allowed(scenario: str) -> None:
    check_scenario_id(scenario)


@pytest.mark.parametrize("scenario", ["me/X-v01", "me/X-v00", "me/X-v12345"])
def test_a_version_that_gymnasium_writes_differently_is_refused(scenario: str) -> None:
    with pytest.raises(ValueError, match="must be of the form namespace/Name-v0"):
        check_scenario_id(scenario)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a/b", "a\\b", "a b", "-a", ".a", "a.", "a--b", "a\n", "\u0430", "a" * 101]
)
def test_no_name_leaves_its_folder_or_hides(name: str) -> None:
    for check in (check_method_name, check_scenario_id, lambda name: check_plain("task", name)):
        if (check, name) != (check_method_name, "a/b"):
            with pytest.raises(ValueError, match="cannot be the"):
                check(name)


@pytest.mark.parametrize(
    "changes",
    ["+x=../..", "+x=a/b", "+x=a:b", "+x=\n", "+x=", "+x", "+=1", "+x=1.", "+x=1 ", "+x=" + "1" * 200],
)
def test_settings_that_cannot_be_in_the_name_of_a_folder_are_refused(changes: str) -> None:
    with pytest.raises(ValueError, match="cannot be the name of a folder"):
        check_label(f"sft{changes}")


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("SFT", "sft"),
        ("s_f_t", "sft"),
        ("s-ft", "sft"),
        ("L0RA", "lora"),
        ("jo1nt", "joint"),
        ("e/wc", "ewc"),
    ],
)
def test_a_name_that_is_read_as_a_built_in_one_is_refused(name: str, other: str) -> None:
    with pytest.raises(ValueError, match=f"would take for '{other}'"):
        check_method_name(name)


@pytest.mark.parametrize("name", ["nul", "Con", "com1", "aux:Method", "prn.x:Method"])
def test_devices_of_windows_are_no_names(name: str) -> None:
    with pytest.raises(ValueError, match="device on Windows"):
        check_method_name(name)
    check_method_name(f"theirs/{name.partition(':')[0].partition('.')[0]}")


def test_no_two_names_have_one_folder() -> None:
    names = ["a/b", "a:b", "a", "b", "a-b/c", "a/b-c", "a.b/c", "a.b:c", "a_b:c"]
    for name in names:
        check_method_name(name)
    folders = [folder_name(name) for name in names]
    assert not any(one == other for one, other in itertools.combinations(folders, 2))
