"""Groups against SciPy, brute force, scores worked by hand and simulated boards."""

from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from clbench.base.errors import InputError
from clbench.scoring.groups import (
    UNKNOWN_DEVIATION,
    deviation_of_differences,
    differences_needed,
    groups,
    least_difference,
    letter_display,
    told_apart,
)
from clbench.scoring.intervals import Runs
from clbench.scoring.layout import Layout
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores

ROOT = Path(__file__).parents[2]


def run(final: Any) -> Scores:
    """Return a run whose outcomes after its only target, the last task, are `final`, (tasks, episodes)."""
    final = np.asarray(final, dtype=float)
    skills = tuple(f"skill_{number}" for number in range(len(final) - 1))
    layout = Layout(skills, ("target",), (), tuple(range(final.shape[1])), (), (), (100,), ("left",))
    missing = np.full((1, 1), np.nan)
    return Scores(
        layout=layout,
        success=np.stack([np.ones_like(final), final]),
        on_the_way=np.zeros((1, 0, len(final), 0)),
        perturbed=np.full((2, len(final), final.shape[1]), np.nan),
        asked=np.full((2, 1), 50.0),
        correct=np.full((2, 1), 25.0),
        answer_curves=missing,
        update_sparsity=missing,
        activation_drift=missing,
        steps=missing[0],
        met=missing[0],
        shift=missing[0],
        captured=missing[0],
        relearning_steps=missing[0, 0],
    )


def equal_run(successes: int, episodes: int = 10, tasks: int = 4) -> Scores:
    """Return a run with the same number of successes on each task."""
    return run(np.tile(np.arange(episodes) < successes, (tasks, 1)))


def row(*successes: int) -> dict[int, Scores]:
    """Return the runs of a row, given the successes in ten episodes of each seed."""
    return {seed: equal_run(count) for seed, count in enumerate(successes)}


def board(
    generator: np.random.Generator, rates: Any, seeds: int, deviation: float, tasks: int = 9
) -> dict[str, Runs]:
    """Return rows of methods with these rates, whose runs have an effect of their own and of their seed."""
    shared = deviation * generator.standard_normal(seeds)
    rows: dict[str, Runs] = {}
    for number, rate in enumerate(rates):
        of_seeds = rate + shared + deviation * generator.standard_normal(seeds)
        rows[f"method_{number}"] = {
            seed: run(generator.random((tasks, 20)) < of_seeds[seed]) for seed in range(seeds)
        }
    return rows


# ---- groups ------------------------------------------------------------------------------------------------


def test_rows_that_are_not_told_apart_share_a_letter_and_the_best_row_has_the_first() -> None:
    rows = {"worst": row(0, 0, 1), "good": row(9, 10, 9), "middle": row(5, 5, 6), "best": row(10, 9, 10)}
    assert groups("final_average", rows) == {"best": "a", "good": "a", "middle": "b", "worst": "c"}
    assert list(groups("final_average", rows)) == ["best", "good", "middle", "worst"]


def test_a_row_between_two_others_can_be_like_both() -> None:
    rows = {"high": row(8, 7, 9, 8), "between": row(6, 7, 6, 7), "low": row(5, 4, 5, 6)}
    assert groups("final_average", rows) == {"high": "a", "between": "ab", "low": "b"}


def test_less_forgetting_is_better() -> None:
    rows = {"forgets": row(1, 1, 2), "keeps": row(9, 10, 9)}
    assert groups("forgetting", rows) == {"keeps": "a", "forgets": "b"}
    assert list(groups("forgetting", rows)) == ["keeps", "forgets"]


@pytest.mark.long
def test_with_complete_boards_rows_are_told_apart_as_by_tukeys_test() -> None:
    # Rows vary enough for the pooled error to be the largest, so that SciPy's test must agree.
    generator = np.random.default_rng(0)
    agreed = 0
    for _ in range(40):
        values = generator.normal([[2.0], [1.5], [0.5], [0.0]], 1.0, (4, 5))
        values = values[np.argsort(-values.mean(axis=1))]
        residuals = values - values.mean(axis=1, keepdims=True) - values.mean(axis=0) + values.mean()
        error = np.sqrt((residuals**2).sum() / 12 / 5)
        pairs = np.triu_indices(4, 1)  # SciPy takes 0.05 s for each
        differences = (values[:, None] - values)[pairs]
        own_is_larger = differences.std(axis=1, ddof=1) / np.sqrt(10) > error
        p_values = stats.studentized_range.sf(abs(differences.mean(axis=1)) / error, 4, 12)
        found = told_apart(values, np.repeat(values[..., None], 2, axis=2))[pairs]
        assert (found == (p_values < 0.05))[~own_is_larger].all()
        agreed += int((found & ~own_is_larger).any())
    assert agreed > 10


def test_a_row_whose_runs_agree_by_chance_gains_nothing() -> None:
    # Both have one mean. By its own noise the even row would be told apart from the best, the uneven not.
    rows = {
        "best": row(8, 6, 9, 7, 8),
        "even": row(5, 5, 5, 5, 5),
        "uneven": row(2, 8, 6, 3, 6),
        "other": row(3, 6, 4, 7, 4),
    }
    assert set(groups("final_average", rows).values()) == {"a"}


def test_a_row_that_varies_more_than_others_is_told_apart_less_easily() -> None:
    def board_of(last: Runs) -> dict[str, Runs]:
        steady = {f"steady_{number}": row(6, 7, 6, 7, 6 + number % 2) for number in range(6)}
        return {**steady, "last": last}

    assert groups("final_average", board_of(row(4, 4, 4, 4, 4)))["last"] == "b"
    assert groups("final_average", board_of(row(0, 8, 1, 9, 2)))["last"] == "a"


def test_a_row_that_varies_far_more_than_many_others_needs_its_own_error() -> None:
    # 20 steady rows, and one whose seeds are 1 higher and lower in turn: differences have a variance of 4 / 3
    steady = 0.01 * np.random.default_rng(0).standard_normal((20, 4))
    noisy = np.array([1.0, -1.0, 1.0, -1.0])
    factor = stats.studentized_range.ppf(0.95, 21, 60) / np.sqrt(2)
    for lower, apart in ((0.9, False), (1.1, True)):
        values = np.vstack([steady, noisy - lower * factor * np.sqrt(4 / 3 / 4)])
        values = values[np.argsort(-values.mean(axis=1))]
        found = told_apart(values, np.repeat(values[..., None], 2, axis=2))
        assert found[-1, :-1].all() == found[-1, :-1].any() == apart


def test_two_rows_without_a_common_seed_are_told_apart_as_by_students_test() -> None:
    generator, agreed = np.random.default_rng(1), set()
    for _ in range(60):
        first, second = generator.normal(1.5, 1.0, 3), generator.normal(0.0, 1.0, 5)
        if first.mean() < second.mean():
            continue
        values = np.full((2, 8), np.nan)
        values[0, :3], values[1, 3:] = first, second
        found = bool(told_apart(values, np.repeat(values[..., None], 2, axis=2))[0, 1])
        assert found == (stats.ttest_ind(first, second).pvalue < 0.05)
        agreed.add(found)
    assert agreed == {True, False}


def test_the_error_of_episodes_is_the_standard_error_of_their_paired_differences() -> None:
    # outcomes of all tasks alike, so that an episode has one outcome
    one, two = (
        np.tile(outcomes, (3, 1)) for outcomes in ([1, 1, 1, 1, 0, 1, 0, 0], [1, 0, 0, 1, 0, 0, 1, 0])
    )
    error = stats.sem(one[0] - two[0])
    seeds = {"one": dict.fromkeys(range(4), run(one)), "two": dict.fromkeys(range(4), run(two))}
    needed = differences_needed("final_average", seeds, "one")
    assert needed["two"] == pytest.approx(stats.t.ppf(0.975, 3) * error / np.sqrt(4))
    # of one seed, another deviation of 0.2 is assumed for each row, beside that of its episodes
    alone = differences_needed("final_average", {"one": {0: run(one)}, "two": {0: run(two)}}, "one")
    of_episodes = (stats.sem(one[0]) ** 2 + stats.sem(two[0]) ** 2) / 2
    assert alone["two"] == pytest.approx(1.95996 * np.sqrt(2 * (0.2**2 + of_episodes)), rel=1e-4)


def test_the_deviation_assumed_for_one_seed_is_a_share_of_the_whole_range_of_the_metric() -> None:
    rows = {"one": row(10), "two": row(10)}
    final, forgetting = (
        differences_needed(name, rows, "one")["two"] for name in ("final_average", "forgetting")
    )
    assert forgetting == pytest.approx(2 * final)  # its range is from -1 to 1


def test_seeds_that_agree_by_chance_do_not_split_rows_that_differ_in_one_episode() -> None:
    rows = {
        "all": row(10, 10, 10),
        "all_but_one": dict.fromkeys(range(3), run([[1] * 10] * 3 + [[1] * 9 + [0]])),
    }
    assert set(groups("final_average", rows).values()) == {"a"}


def test_rows_with_identical_outcomes_share_a_letter_and_others_do_not() -> None:
    rows = {"one": row(10, 10, 10), "two": row(10, 10, 10), "none": row(0, 0, 0)}
    assert groups("final_average", rows) == {"one": "a", "two": "a", "none": "b"}
    assert groups("final_average", {"alone": row(3, 4)}) == {"alone": "a"}


def test_a_row_with_one_seed_is_compared_by_that_seed() -> None:
    # Seed 1 is easy for all rows, by far: the row that has no other would be worst by its mean.
    rows: dict[str, Runs] = {
        "one": {0: equal_run(2), 1: equal_run(9), 2: equal_run(8)},
        "two": {0: equal_run(2), 1: equal_run(8), 2: equal_run(9)},
        "three": {0: equal_run(1), 1: equal_run(9), 2: equal_run(9)},
        "single": {0: equal_run(2)},
    }
    assert set(groups("final_average", rows).values()) == {"a"}
    assert groups("final_average", {**rows, "single": {1: equal_run(0)}})["single"] == "b"


def test_rows_are_not_told_apart_if_their_common_seeds_say_the_opposite() -> None:
    # The row with more seeds is better by its mean, but far worse in the only seed that both have.
    rows: dict[str, Runs] = {
        "one": {0: equal_run(1), 1: equal_run(10), 2: equal_run(10)},
        "two": {0: equal_run(1), 1: equal_run(10), 2: equal_run(10)},
        "single": {0: equal_run(6)},
    }
    assert groups("final_average", rows) == {"one": "a", "two": "a", "single": "a"}
    # Here the difference in that seed, 0.8, is twice what is needed: it is the order alone that forbids it.
    certain: dict[str, Runs] = {str(number): row(0, 10, 10, 10, 10, 10) for number in range(4)}
    certain["single"] = row(8)
    assert differences_needed("final_average", certain, "0")["single"] < 0.42
    assert set(groups("final_average", certain).values()) == {"a"}


def test_rows_without_a_common_seed_are_compared_by_the_variation_of_runs() -> None:
    near: dict[str, Runs] = {"one": row(8, 9, 7), "two": {seed + 5: equal_run(7) for seed in range(3)}}
    far: dict[str, Runs] = {**near, "two": {seed + 5: equal_run(1) for seed in range(3)}}
    assert groups("final_average", near) == {"one": "a", "two": "a"}
    assert groups("final_average", far) == {"one": "a", "two": "b"}


def test_where_no_row_has_a_second_seed_only_distant_rows_are_told_apart() -> None:
    # The studentised range of three, their deviation known, is 3.31: at least 3.31 * 0.2 = 0.66 is needed.
    assert pytest.approx(0.2) == UNKNOWN_DEVIATION
    near, far = ({"one": row(9), "two": row(9), "three": row(last)} for last in (3, 1))
    assert groups("final_average", near)["three"] == "a"
    assert groups("final_average", far)["three"] == "b"


def test_rows_without_value_are_in_no_group() -> None:
    broken = equal_run(5)
    broken.success[-1, 0, 0] = np.nan
    rows = {"whole": row(5, 6), "broken": {0: broken, 1: equal_run(5)}, "empty": {}}
    assert groups("final_average", rows) == {"whole": "a"}
    assert groups("final_average", {}) == {}


def test_a_metric_without_a_direction_orders_nothing() -> None:
    with pytest.raises(ValueError, match=r"Rows cannot be ordered by update_sparsity, .*: .*final_average"):
        groups("update_sparsity", {"one": row(5, 6)})
    with pytest.raises(LookupError, match="final_average"):
        groups("final_averages", {})


def test_rows_of_other_tasks_are_not_compared() -> None:
    with pytest.raises(ValueError, match="different tasks"):
        groups("final_average", {"one": row(5, 6), "two": {0: equal_run(5, episodes=20)}})


# ---- letters -----------------------------------------------------------------------------------------------


def pairs_apart(generator: np.random.Generator, rows: int) -> Any:
    upper = np.triu(generator.random((rows, rows)) < generator.random(), 1)
    return upper | upper.T


def test_letters_are_the_largest_sets_of_rows_of_which_no_two_are_told_apart() -> None:
    generator = np.random.default_rng(0)
    for rows in (1, 2, 3, 5, 7):
        for _ in range(20):
            apart = pairs_apart(generator, rows)
            subsets = [set(some) for size in range(1, rows + 1) for some in combinations(range(rows), size)]
            alike = [
                some for some in subsets if not any(apart[pair] for pair in combinations(sorted(some), 2))
            ]
            largest = [some for some in alike if not any(some < other for other in alike)]
            letters = letter_display(apart)
            named = {letter for one in letters for letter in one}
            found = [{row for row in range(rows) if letter in letters[row]} for letter in sorted(named)]
            assert sorted(map(sorted, found)) == sorted(map(sorted, largest))


def test_two_rows_share_a_letter_if_and_only_if_they_are_not_told_apart() -> None:
    apart = pairs_apart(np.random.default_rng(1), 20)
    letters = letter_display(apart)
    for one, other in combinations(range(20), 2):
        assert bool(set(letters[one]) & set(letters[other])) != apart[one, other]


def test_groups_are_named_in_the_order_of_their_first_rows() -> None:
    # Each row is like its neighbours alone.
    apart = np.abs(np.subtract.outer(np.arange(5), np.arange(5))) > 1
    assert letter_display(apart) == ["a", "ab", "bc", "cd", "d"]
    assert letter_display(np.zeros((3, 3), dtype=np.bool_)) == ["a", "a", "a"]


def test_more_groups_than_letters_of_the_alphabet_have_names_of_one_letter() -> None:
    letters = letter_display(~np.eye(40, dtype=np.bool_))
    assert all(len(letter) == 1 for letter in letters)
    assert len(set(letters)) == 40


# ---- differences and boards --------------------------------------------------------------------------------


def of_rates(*rates: float) -> Runs:
    """Return runs of seeds 0, 1, ... whose final success is `rates` on both of their tasks."""
    return {seed: run(np.tile(np.arange(20) < round(20 * rate), (2, 1))) for seed, rate in enumerate(rates)}


def test_the_deviation_of_differences_is_the_residual_after_row_and_seed_means() -> None:
    rows = [of_rates(0.5, 0.7, 0.6), of_rates(0.2, 0.5, 0.2), of_rates(0.9, 0.9, 1.0)]
    values = np.array([[0.5, 0.7, 0.6], [0.2, 0.5, 0.2], [0.9, 0.9, 1.0]])
    residuals = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    expected = np.sqrt(2 * (residuals**2).sum() / 4)  # twice the variance of a run, on (3 - 1)(3 - 1) degrees
    assert deviation_of_differences("final_average", rows) == pytest.approx(expected)


def test_rows_that_move_together_from_seed_to_seed_differ_by_the_same() -> None:
    together = [of_rates(0.5, 0.9), of_rates(0.1, 0.5)]
    assert deviation_of_differences("final_average", together) == pytest.approx(0, abs=1e-12)


def test_the_least_difference_is_tukeys_for_all_rows() -> None:
    expected = stats.studentized_range.ppf(0.95, 10, 27) * 0.06 / np.sqrt(2 * 4)
    assert least_difference(0.06, 10, 4) == pytest.approx(expected)
    # of two rows it is half of the width of the interval of their difference
    assert least_difference(0.06, 2, 4) == pytest.approx(stats.t.ppf(0.975, 3) * 0.06 / 2)


def test_rows_are_told_apart_beyond_the_difference_that_is_needed() -> None:
    rows = board(np.random.default_rng(0), [0.8, 0.7, 0.65, 0.5, 0.45], 4, 0.05)
    letters = groups("final_average", rows)
    base = "method_2"
    needed = differences_needed("final_average", rows, base)
    assert needed.keys() == rows.keys() - {base}
    values = {
        name: np.mean([measure("final_average", run) or 0.0 for run in runs.values()])
        for name, runs in rows.items()
    }
    for name, least in needed.items():
        apart = not set(letters[name]) & set(letters[base])
        assert apart == (abs(values[name] - values[base]) > least)
    assert differences_needed("final_average", {"alone": row(5, 6)}, "other") == {}


def test_metrics_that_compare_with_a_reference_do_not_order_rows() -> None:
    rows = {"one": row(5, 6), "other": row(7, 8)}
    with pytest.raises(InputError, match="gain compares a row with sft"):
        groups("gain", rows)
    with pytest.raises(InputError, match="gain compares a row with sft"):
        deviation_of_differences("gain", rows.values())


def test_rows_of_other_tasks_have_no_deviation() -> None:
    others = {0: equal_run(5, tasks=2), 1: equal_run(6, tasks=2)}
    with pytest.raises(InputError, match="different tasks"):
        deviation_of_differences("final_average", [row(5, 6), others])


def test_with_one_seed_a_number_of_steps_tells_nothing_apart() -> None:
    quick, slow = (replace(equal_run(5), relearning_steps=np.asarray(steps)) for steps in (1.0, 900.0))
    assert groups("relearning_steps", {"quick": {0: quick}, "slow": {0: slow}}) == {"quick": "a", "slow": "a"}


def test_without_two_rows_with_two_common_seeds_runs_vary_around_their_row() -> None:
    # one row with four seeds, the others with one: the four tell how much runs vary
    successes = {"four": (50, 52, 50, 52), "best": (100,), "worst": (0,)}
    rows = {
        name: {seed: equal_run(count, episodes=100) for seed, count in enumerate(counts)}
        for name, counts in successes.items()
    }
    assert groups("final_average", rows) == {"best": "a", "four": "b", "worst": "c"}


def test_without_two_common_seeds_of_two_rows_no_deviation_is_known() -> None:
    late = {seed + 1: scores for seed, scores in of_rates(0.5, 0.9).items()}
    for rows in ([], [of_rates(0.5, 0.9)], [of_rates(0.5), of_rates(0.6)], [of_rates(0.5, 0.9), late]):
        assert deviation_of_differences("final_average", rows) is None


@pytest.mark.long
@pytest.mark.parametrize(("methods", "seeds", "deviation"), [(5, 3, 0.05), (8, 3, 0.1)])
def test_boards_of_equal_methods_are_hardly_ever_split(methods: int, seeds: int, deviation: float) -> None:
    generator = np.random.default_rng(0)
    boards = (board(generator, [0.5] * methods, seeds, deviation) for _ in range(40))
    split = sum(set(groups("final_average", rows).values()) != {"a"} for rows in boards)
    assert split <= 5  # 2 expected


def test_methods_that_differ_clearly_are_told_apart() -> None:
    generator = np.random.default_rng(0)
    right = []
    for _ in range(10):
        found = groups("final_average", board(generator, [0.8] * 3 + [0.5] * 3, 3, 0.05))
        for good, bad in product(range(3), range(3, 6)):
            right.append(not set(found[f"method_{good}"]) & set(found[f"method_{bad}"]))
    assert np.mean(right) > 0.9


def test_a_whole_board_falls_into_several_groups() -> None:
    rows = board(np.random.default_rng(0), np.linspace(0.1, 0.9, 23), 5, 0.05)
    found = groups("final_average", rows)
    assert 1 < len({letter for letters in found.values() for letter in letters}) < 23
