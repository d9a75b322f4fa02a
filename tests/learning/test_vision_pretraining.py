"""Vision that learns to describe pictures, before a policy learns to act."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from clbench.base.errors import InputError
from clbench.base.seeding import torch_generator
from clbench.data.questions import Questions, load_questions
from clbench.learning.pretraining import policy_config, pretrained_policy, vision_steps
from clbench.learning.vision_pretraining import Pictures, pictures_of, pretrain_vision
from clbench.policy.vision import Vision
from clbench.testing import TOY
from clbench.testing.seen_toy import SEEN_TOY
from clbench.testing.toy_camera import ToyCamera

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def questions() -> tuple[Questions, Questions]:
    """Questions about pictures of the toy, for training and for the test."""
    return load_questions(SEEN_TOY)


def _new_vision() -> Vision:
    config = policy_config(SEEN_TOY)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return Vision(config.image_size, config.width)


def test_a_vision_needs_a_channel_in_its_first_convolution() -> None:
    assert Vision(32, 6).width == 6
    with pytest.raises(InputError, match="width must be at least 6 for a policy that sees, not 5"):
        Vision(32, 5)


def _pictures(questions: Questions) -> list[Pictures]:
    return pictures_of([(questions.scenes, questions.image)], ToyCamera, questions.kinds)


def _pretrained(questions: Questions, steps: int) -> Vision:
    vision = _new_vision()
    generator = torch_generator("vision", 0)
    pretrain_vision(vision, _pictures(questions), questions.kinds, steps, generator)
    return vision


@torch.no_grad()
def _error(vision: Vision, train: Questions, test: Questions) -> float:
    """Return the error of a least-squares fit on the tokens that locates the objects in new pictures."""

    def inputs(part: Questions) -> Tensor:
        return torch.nn.functional.pad(vision(part.image).flatten(1), (0, 1), value=1.0).double()

    fit = np.linalg.lstsq(inputs(train).numpy(), train.scenes[:, :4].double().numpy(), rcond=1e-6)[0]
    predicted = inputs(test).numpy() @ fit
    return float(np.abs(predicted - test.scenes[:, :4].numpy()).mean())


@pytest.mark.long
def test_the_vision_learns_to_locate_the_objects_in_a_picture(questions: tuple[Questions, Questions]) -> None:
    train, test = questions
    assert _error(_pretrained(train, 150), train, test) < 0.6 * _error(_new_vision(), train, test)


def test_the_same_generator_gives_the_same_vision(questions: tuple[Questions, Questions]) -> None:
    first, second = (_pretrained(questions[0], 5).state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_numbers_are_about_one_and_answers_match_the_questions(
    questions: tuple[Questions, Questions],
) -> None:
    train, test = questions
    sets = [(part.scenes, part.image) for part in (train, test)]
    pictures = pictures_of(sets, ToyCamera, train.kinds)
    numbers = torch.cat([one.numbers for one in pictures])
    low, middle, high = numbers.quantile(torch.tensor([0.25, 0.5, 0.75]), dim=0)
    torch.testing.assert_close(middle, torch.zeros(4), atol=0.01, rtol=0)
    torch.testing.assert_close(high - low, torch.full((4,), 1.35), atol=0.01, rtol=0)
    for column, kind in enumerate(train.kinds):
        assert pictures[1].answers[:, column].tolist() == kind.answer(test.scenes.numpy()).tolist()


def test_an_outlier_does_not_outweigh_the_other_pictures(questions: tuple[Questions, Questions]) -> None:
    train = questions[0]
    scenes = train.scenes.clone()
    scenes[0, 0] = 1000.0
    (pictures,) = pictures_of([(scenes, train.image)], ToyCamera, train.kinds)
    assert pictures.numbers.abs().max() == 5.0


def test_a_question_without_an_answer_in_any_picture_of_a_step_does_no_harm(
    questions: tuple[Questions, Questions],
) -> None:
    (pictures,) = _pictures(questions[0])
    silent = Pictures(pictures.image, pictures.numbers, torch.full_like(pictures.answers, -1))
    vision = _new_vision()
    pretrain_vision(vision, [silent], questions[0].kinds, 3, torch_generator("vision", 0))
    assert all(torch.isfinite(parameter).all() for parameter in vision.parameters())


def test_each_step_sums_the_loss_of_the_numbers_three_times_and_the_mean_over_kinds_of_questions(
    questions: tuple[Questions, Questions],
) -> None:
    steps, kinds = 4, questions[0].kinds
    (pictures,) = _pictures(questions[0])
    pictures.answers[::3] = -1  # too close to call
    made, vision = _new_vision(), _new_vision()
    pretrain_vision(made, [pictures], kinds, steps, torch_generator("vision", 0))
    generator = torch_generator("vision", 0)
    outputs = 4 + sum(len(kind.answers) for kind in kinds)
    weight = torch.zeros(outputs, vision.tokens * vision.width).normal_(std=0.02, generator=generator)
    trained = [
        *vision.parameters(),
        weight.requires_grad_(),
        bias := torch.zeros(outputs, requires_grad=True),
    ]
    optimiser = torch.optim.AdamW(trained, betas=(0.9, 0.95), weight_decay=1e-10, fused=True)
    for step in range(steps):
        # one step of warm-up, then a cosine down to a tenth
        share = 0.1 + 0.45 * (1 + math.cos(math.pi * max(0, step - 1) / (steps - 1)))
        optimiser.param_groups[0]["lr"] = 3e-3 * share
        rows = torch.randint(len(pictures.image), (64,), generator=generator)
        predicted = vision(pictures.image[rows]).flatten(1) @ weight.T + bias
        away = (predicted[:, :4] - pictures.numbers[rows]).abs()
        losses, first = [], 4
        for column, kind in enumerate(kinds):
            logits = predicted[:, first : (first := first + len(kind.answers))].log_softmax(dim=1)
            answers = pictures.answers[rows, column]
            known = answers >= 0
            losses.append(-logits[known].gather(1, answers[known, None]).mean())
        loss = 3 * torch.where(away < 0.1, away**2 / 0.2, away - 0.05).mean() + sum(losses) / len(losses)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimiser.step()
    for one, other in zip(made.parameters(), vision.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)


@pytest.mark.long
@pytest.mark.usefixtures("empty_caches")
def test_progress_includes_the_steps_of_the_vision() -> None:
    scenario = dataclasses.replace(
        SEEN_TOY, budget=dataclasses.replace(SEEN_TOY.budget, demonstrations=4, pretraining_steps=8)
    )
    done: list[float] = []
    pretrained_policy(scenario, 0, done.append)
    assert sum(done) == 8 + vision_steps(scenario) == 10
    assert vision_steps(TOY) == 0
