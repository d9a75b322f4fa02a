"""ConSFT: samples that the policy is not yet confident about get a smaller weight (arXiv 2605.08879).

The weight of a sample with loss L is omega = max(omega_min, exp(-kappa L / tau)), and no gradient flows
through omega (Eq. 4, 5, 11 and 12). The temperature tau rises from `tau_start` to `tau_end` over the
schedule: training begins conservatively, and ends as plain fine-tuning where losses are small compared with
tau_end / kappa, which is 0.2. The method adds no data, no network and no memory.

The formulas and constants come from two other readers' notes on the paper, which agree. We have read only its
abstract: below, "the paper" means the paper as these notes describe it.

Details:
1. The batch loss is the mean of omega_i L_i. It is never divided by the sum of the weights: that would cancel
   most of the method.
2. L_i is the mean over the valid steps and the dimensions of the action chunk, at the one draw of flow time
   and noise that the step trains on. The paper does not specify this reduction. LeRobot's pi0 also averages
   over the robot's own dimensions. openpi averages over 32 dimensions, padding included: for a robot with 7
   dimensions of its own, its losses are up to 4.6 times smaller.
3. The schedule restarts with each target. The paper tunes its length T for each task (2,000 steps there).
   Here T is the length of the stage, so that tau does not reach `tau_end`: at the last of 300 steps it is
   0.39. If the stage ends when the target is learned, T is the median number of steps that plain fine-tuning
   takes to learn a target of MetaWorld-v1. Easy targets are then learned before the schedule ends, as in 12
   of the 28 stages of `consft` that train there, 15 of 32 on PointMaze-v1, 12 of 45 on Fetch-v1, and 1 of 16
   on LiberoSpatial-v1. On PointMaze-v1, plain fine-tuning takes 2.2 to 3.0 times as many steps at the same
   learning rate, so `schedule`, the factor of T, is 3.25. The factor also multiplies the 7.5 steps of T that
   make up for the warm-up: at the scenario's own learning rate, T is 37 there, while plain fine-tuning takes
   24. On LiberoSpatial-v1, plain fine-tuning takes 3.0 to 4.4 times as many steps by the median, and
   `schedule` is 3.5. On Fetch-v1, it takes 1.4 to 1.9 times as many by the mean, and the schedule ends within
   a stage. The schedule was not made longer there: on the tuning seeds, twice the length scored 0.589, and
   the present length 0.604. ConSFT thus tried one setting more than other methods there; the count of six
   settings tried, on this page and on the board, does not include it.
4. At the end temperature a loss of 0.3 still has a weight of 0.22. In the last tenth of the schedule and
   after it, 11 % of the weights of `consft` are above 0.9 on Fetch-v1 and 15 % below 0.01 (MetaWorld-v1: 12
   and 27 %; PointMaze-v1: 27 and 17 %; LiberoSpatial-v1: 24 and 4 %): with this policy's losses, training
   does not end as plain fine-tuning.
5. For a policy that fills in masked tokens, the loss is a cross-entropy in nats, and no constant was adapted
   to it: 98 % of the weights are below 0.01 at the start, and 68 % at the end. Such rows say little about
   ConSFT.
6. The learning rate, the optimiser and the clipping are the benchmark's, the same for every method. Adam
   nearly cancels a constant factor of the loss: only the clipping at norm 1 and Adam's epsilon depend on it.
   On Fetch-v1, seed 2, stages of 6 to 16 steps with all weights below 0.01 move hidden states 6 to 8 % less
   than sft does. In a policy of 3.3 billion parameters, a gradient of norm 1, multiplied by the floor, has a
   root mean square of 1.7e-8, near Adam's epsilon of 1e-8: there, the floor shortens steps. Here the root
   mean square is 1.2e-6. But Adam does not cancel a factor that changes. When all weights rise together, at
   the end of the schedule, its averages still hold small gradients: with equal gradients and a T of 11.5
   steps, the next step has 0.42 of a plain step's length, and the tenth 0.94. On Fetch-v1, seed 0, at a step
   factor of 1, 18 steps of the pretrained policy on `push_right` or `press` move the weights 26 % less than
   sft does; if all weights stay at the floor, the distances differ by less than 2 %. This second warm-up
   favours no sample: `constant_weight` has it, too.
7. A `loss_scale` of s equals a `tau_start` of 0.003 / s, exactly, until that temperature reaches `tau_end`,
   and the paper leaves `tau_start` free: 0.01 equals a `tau_start` of 0.3 in the first 97 % of the schedule,
   0.003 one of 1 in the first 91 %, and 0.001 one of 3 in the first 72 %. After that, only `loss_scale` still
   raises the weights.
8. With the three values of `tau_start`, no setting of `consft` gives differing weights to 10 % of the samples
   on Fetch-v1 and MetaWorld-v1, the share that docs/reference/claims.md asks for. The most is 5 %, with 0.3.
   The three values end too low: a `tau_start` of 1, which equals a `loss_scale` of 0.003, gives such weights
   to 17 % of the samples there, and to 23 % on PointMaze-v1.
9. Where a stage ends when the target is learned, a `schedule` of 1 ends within the benchmark's warm-up of 15
   steps at a step factor of 1, where T is 11.5 steps, and soon after it at 0.3, where T is 21. Low weights
   and small learning rates then coincide, and little of the conservative phase is ConSFT's alone. At a factor
   of 1, the schedule outlasts the warm-up only on PointMaze-v1, where T is 37, and on LiberoSpatial-v1, where
   T is 40. The paper's T is 2,000.

`ConSFTCalibrated` multiplies the loss by `loss_scale` inside the weight, and keeps the other constants.
Before the last tenth of the schedule, the published constants give a weight above 0.01 only to losses below
0.0024. The losses of this policy are larger, so nearly all weights stay at the floor until the schedule ends.
We do not know how large the paper's losses are. With the factor 0.003, a loss of 0.03 has a weight of 0.5 at
the start. The factor also applies at the end temperature: 86 to 94 % of the weights are above 0.9 then, so
this arm does end as plain fine-tuning. Where methods are tuned, `clbench tune` chose `tau_start` of ConSFT
and `loss_scale` of ConSFTCalibrated, each from three values; the records hold the chosen value.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Progress

from ._consft_weights import CalibratedSFT, WeightedSFT


@dataclass
class ConSFT(WeightedSFT):
    """Weight each sample's loss by the policy's confidence in the sample."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the policy's confidence in each sample (B,)."""
        return self.confidence(losses, progress)


@dataclass
class ConSFTCalibrated(CalibratedSFT):
    """Weight each sample's loss by the confidence that follows from the scaled loss."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the policy's confidence in each sample (B,)."""
        return self.confidence(losses, progress)
