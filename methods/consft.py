"""ConSFT: samples that the policy is not yet confident of get a smaller weight (arXiv 2605.08879).

The weight of a sample with loss L is omega = max(omega_min, exp(-kappa L / tau)), and no gradient flows
through omega (Eq. 5, 11 and 12). The temperature tau rises from `tau_start` to `tau_end` over the schedule:
training begins conservatively, and ends as plain fine-tuning where losses are small against tau_end / kappa,
which is 0.2. The method adds no data, no network and no memory.

Formulas and constants are from two notes by other readers of the paper, which agree. We have read its
abstract only: "the paper" below is the paper as these notes describe it.

Details:
1. The batch loss is the mean of omega_i L_i. It is never divided by the sum of the weights: that would cancel
   most of the method.
2. L_i is the mean over the valid steps and the dimensions of the action chunk, at the one draw of flow time
   and noise that the step trains on. The paper does not specify this reduction. LeRobot's pi0 also averages
   over the robot's own dimensions. openpi averages over 32, padding included: with 7 of the robot's own, its
   losses are up to 4.6 times smaller.
3. The schedule restarts with each target. The paper tunes its length T for each task (2,000 steps there).
   Here T is the length of the stage, so that tau does not reach `tau_end`: at the last of 300 steps it is
   0.39. If the stage ends when the target is learned, T is the number of steps that plain fine-tuning takes
   to learn one on MetaWorld-v1, in the median: an easy target is learned before the schedule ends, as in 12
   of the 28 stages of `consft` that train there, 8 of 16 on PointMaze-v1, 12 of 45 on Fetch-v1, and 1 of 16
   on LiberoSpatial-v1. On PointMaze-v1, plain fine-tuning takes 2.2 to 3.0 times as many steps at the same
   learning rate, so `schedule`, the factor of T, is 3.25. It also multiplies the 7.5 steps of T that make up
   for the warm-up: at the scenario's own learning rate, T is 37 there, where plain fine-tuning takes 24. On
   LiberoSpatial-v1 it takes 3.0 to 4.4 times as many by the median, and `schedule` is 3.5. On Fetch-v1, plain
   fine-tuning takes 1.4 to 1.9 times as many steps by the mean, and the schedule ends within a stage. It was
   not made longer there: on the tuning seeds, twice the length scored 0.589, and the present length 0.604.
   ConSFT thus tried one setting more than others there; the settings tried, on this page and on the board,
   count six, without it.
4. At the end temperature a loss of 0.3 still has a weight of 0.22. In the last tenth of the schedule and
   after it, 11 % of the weights of `consft` are above 0.9 on Fetch-v1 and 15 % below 0.01 (MetaWorld-v1: 12
   and 27 %; PointMaze-v1: 28 and 16 %; LiberoSpatial-v1: 24 and 4 %): with this policy's losses, it does not
   end as plain fine-tuning.
5. On a policy that fills in masked tokens, the loss is a cross-entropy in nats, and no constant was adapted:
   98 % of the weights are below 0.01 at the start, and 68 % at the end. Such rows say little about ConSFT.
6. Learning rate, optimiser and clipping are the benchmark's, the same for every method. Adam nearly cancels
   a constant factor of the loss: only the clipping at norm 1 and Adam's epsilon see it. On Fetch-v1, seed 2,
   stages of 6 to 16 steps with all weights below 0.01 move hidden states 6 to 8 % less than sft does. In a
   policy of 3.3 billion parameters, a gradient of norm 1 times the floor has a root mean square of 1.7e-8,
   near Adam's epsilon of 1e-8: there, the floor shortens steps. Here it is 1.2e-6.
7. A `loss_scale` of s is a `tau_start` of 0.003 / s, exactly, until that temperature reaches `tau_end`, and
   the paper leaves `tau_start` free: 0.01 is a `tau_start` of 0.3 in the first 97 % of the schedule, 0.003
   one of 1 in the first 91 %, and 0.001 one of 3 in the first 72 %. After that, only the factor still raises
   the weights.
8. The three values of `tau_start` let no setting of `consft` give differing weights to 10 % of the samples on
   Fetch-v1 and MetaWorld-v1: 5 % at most, with 0.3 (the share that docs/reference/claims.md asks for). They
   end too low: 1, as a `loss_scale` of 0.003, gives such weights to 17 % there, and to 23 % on PointMaze-v1.
9. Where a stage ends when the target is learned, a `schedule` of 1 ends within the benchmark's warm-up of 15
   steps: T is 11.5 steps at a step factor of 1, and 21 at 0.3. Low weights and small learning rates then
   coincide, and little of the conservative phase is ConSFT's alone. The schedule outlasts the warm-up only on
   PointMaze-v1, with T = 37 at a factor of 1, and on LiberoSpatial-v1, with 40. The paper's T is 2,000.

`ConSFTCalibrated` multiplies the loss by `loss_scale` inside the weight, and keeps the other constants.
Before the last tenth of the schedule, the published constants give only losses below 0.0024 a weight above
0.01. The losses of this policy are larger, so nearly all weights stay at the floor until the schedule ends.
We do not know how large the paper's losses are. Multiplied by 0.003, a loss of 0.03 has a weight of 0.5 at
the start. The factor holds at the end temperature, too: 86 to 95 % of the weights are above 0.9 then, so that
this arm does end as plain fine-tuning. Where methods are tuned, `clbench tune` chose `tau_start` of ConSFT
and `loss_scale` of ConSFTCalibrated, each from three values; the records have the value.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Progress

from ._consft_weights import CalibratedSFT, WeightedSFT


@dataclass
class ConSFT(WeightedSFT):
    """Weigh each sample's loss by the policy's confidence in it."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the policy's confidence in each sample (B,)."""
        return self.confidence(losses, progress)


@dataclass
class ConSFTCalibrated(CalibratedSFT):
    """Weigh each sample's loss by confidence, with the loss scaled to this policy's."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the policy's confidence in each sample (B,)."""
        return self.confidence(losses, progress)
