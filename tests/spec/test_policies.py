"""Names of policies: a kind, a size, or a class of your own."""

import pytest

from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.learning.pretraining import policy_config
from clbench.policy.kinds import new_policy
from clbench.records.paths import record_name, table_name, table_parts
from clbench.spec.policies import (
    POLICIES,
    check_policy_name,
    is_built_in,
    kind_of,
    policy_name,
    policy_names,
    policy_packages,
    size_of,
)
from clbench.testing.toy import TOY


def test_every_kind_has_three_sizes_and_the_small_one_has_the_plain_name() -> None:
    assert len(policy_names()) == 3 * len(POLICIES)
    assert policy_name("flow") == policy_name("flow", "small") == "flow"
    assert policy_name("discrete_diffusion", "large") == "discrete_diffusion-large"
    for name in policy_names():
        check_policy_name(name)
        assert is_built_in(name)
        assert kind_of(name) in POLICIES
        assert policy_packages(name) == []


def test_a_class_has_no_size_of_ours() -> None:
    name = "clbench.testing.toy:ToyWorld"
    check_policy_name(name)
    assert (kind_of(name), size_of(name), is_built_in(name)) == (name, None, False)
    assert policy_packages(name) == ["clbench.testing"]


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("flaw", "Did you mean 'flow'"),
        ("flow-bas", "Did you mean 'flow-base'"),
        ("flow-small", "No policy is called 'flow-small'"),
        ("", "No policy is called ''"),
        ("../flow", "No policy"),
        ("module:", "No policy"),
        ("a" * 99 + ":B", "No policy"),
        ("mod ule:Class", "No policy"),
        ("ws://localhost:8000", "`clbench score` plays a policy behind a server"),
        ("mine.Mine", "Did you mean 'mine:Mine'"),
        ("mine.py", "Did you mean a class of this file, as 'mine:Class'"),
    ],
)
def test_another_name_is_refused_with_the_nearest_one(name: str, hint: str) -> None:
    with pytest.raises(UnknownNameError, match=hint):
        check_policy_name(name)
    with pytest.raises(UnknownNameError, match=hint):
        TOY.with_policy(name)


def test_an_unknown_size_is_refused_with_the_nearest_one() -> None:
    with pytest.raises(UnknownNameError, match=r"No size of a policy is called 'bas'\. Did you mean 'base'"):
        policy_name("flow", "bas")


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("flow", "Toy-v0"),
        ("flow-base", "Toy-v0+flow-base"),
        ("discrete_diffusion", "Toy-v0+discrete_diffusion"),
        ("my.policies:Net", "Toy-v0+my.policies.Net"),
    ],
)
def test_each_policy_has_a_table_and_a_folder_of_its_own(name: str, folder: str) -> None:
    assert table_parts(table_name("clbench/Toy-v0", name)) == ("clbench/Toy-v0", name)
    assert record_name("clbench/Toy-v0", "sft", 0, policy=name).parts == (folder, "sft", "seed-0.json")


@pytest.mark.long
@pytest.mark.parametrize(("size", "least", "most"), [("base", 4.5e6, 5.5e6), ("large", 36e6, 44e6)])
def test_larger_policies_have_about_5_and_40_million_parameters(size: str, least: float, most: float) -> None:
    for kind in POLICIES:
        policy = new_policy(policy_config(TOY.with_policy(policy_name(kind, size))))
        assert least < sum(parameter.numel() for parameter in policy.parameters()) < most


def test_a_class_is_named_by_a_text_and_has_no_size_of_ours_to_choose() -> None:
    with pytest.raises(
        WrongTypeError, match="A policy is given by a name, such as 'module:Class', not by <cl"
    ):
        check_policy_name(object)  # type: ignore[arg-type]
    with pytest.raises(
        InputError, match="Only flow and discrete_diffusion have sizes; mine:Mine cannot have the size base"
    ):
        policy_name("mine:Mine", "base")
