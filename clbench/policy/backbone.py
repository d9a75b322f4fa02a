"""The backbone: a transformer that reads the observation and the words and answers questions."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from clbench.policy.vision import Vision


class Attention(nn.Module):
    """Multi-head attention: queries read the memory, which may contain them."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, memory: Tensor, mask: Tensor) -> Tensor:
        """Map tokens (B, Q, W), memory (B, P, W) and mask (B, 1, Q or 1, P) to (B, Q, W)."""
        return self.attend(tokens, self.keys_and_values(memory), mask)

    def keys_and_values(self, memory: Tensor) -> Tensor:
        """Return the keys and values of the memory (B, P, W), (2, B, heads, P, W / heads)."""
        batch, length, _ = memory.shape
        both = self.key_value(memory).view(batch, length, 2, self.heads, -1)
        return cast(Tensor, both.permute(2, 0, 3, 1, 4))

    def attend(self, tokens: Tensor, keys_and_values: Tensor, mask: Tensor) -> Tensor:
        """Map tokens (B, Q, W) to (B, Q, W): their queries read the keys and values."""
        batch, length, width = tokens.shape
        query = self.query(tokens).view(batch, length, self.heads, -1).transpose(1, 2)
        key, value = keys_and_values
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return cast(Tensor, self.out(mixed.transpose(1, 2).reshape(batch, length, width)))


class Layer(nn.Module):
    """A pre-norm transformer layer."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(width)
        self.attention = Attention(width, heads)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )

    def forward(self, tokens: Tensor, mask: Tensor, prefix: Tensor | None = None) -> Tensor:
        """Map tokens (B, Q, W) to (B, Q, W). They also attend to the prefix (B, P, W), if there is one."""
        own = self.attention_norm(tokens)
        memory = own if prefix is None else torch.cat([self.attention_norm(prefix), own], dim=1)
        tokens = tokens + self.attention(own, memory, mask)
        return tokens + cast(Tensor, self.feed_forward(tokens))

    def keys_and_values(self, tokens: Tensor) -> Tensor:
        """Return the keys and values of the tokens (B, Q, W), (2, B, heads, Q, W / heads)."""
        return self.attention.keys_and_values(self.attention_norm(tokens))

    def go_on(self, tokens: Tensor, mask: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Map tokens (B, Q, W) to (B, Q, W) like `forward`, given the keys and values of earlier tokens.

        Args:
            tokens: Tokens that follow the earlier ones.
            mask: Mask, (B, 1, Q, P + Q), True where read.
            before: Keys and values of P earlier tokens, (2, B, heads, P, W / heads).

        Returns:
            The mapped tokens, and the keys and values of the earlier tokens and of these.
        """
        own = self.attention_norm(tokens)
        known = torch.cat([before, self.attention.keys_and_values(own)], dim=3)
        tokens = tokens + self.attention.attend(own, known, mask)
        return tokens + cast(Tensor, self.feed_forward(tokens)), known


class Backbone(nn.Module):
    """Reads [observation tokens; a readout token; word tokens], every token attending to every other.

    The observation has `state_tokens` tokens of the state, then the tokens of the image, if there is one.
    """

    state_tokens = 4

    def __init__(
        self,
        state_size: int,
        vocabulary_size: int,
        text_length: int,
        width: int,
        layers: int,
        heads: int,
        image_size: int = 0,
    ):
        super().__init__()
        self.vision = Vision(image_size, width) if image_size else None
        self.observation_tokens = self.state_tokens + (0 if self.vision is None else self.vision.tokens)
        self.observation = nn.Linear(state_size, self.state_tokens * width)
        self.words = nn.Embedding(vocabulary_size, width)
        self.readout = nn.Parameter(torch.zeros(1, 1, width))
        self.position = nn.Parameter(0.02 * torch.randn(1, self.observation_tokens + 1 + text_length, width))
        self.layers = nn.ModuleList(Layer(width, heads) for _ in range(layers))
        self.answer = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, vocabulary_size))
        nn.init.normal_(self.words.weight, std=0.5)

    def mask(self, words: Tensor) -> Tensor:
        """Return the mask of the tokens to read, (B, 1, 1, P): all but the padding of the words (B, L)."""
        always = torch.ones(len(words), self.observation_tokens + 1, dtype=torch.bool, device=words.device)
        return torch.cat([always, words != 0], dim=1)[:, None, None, :]

    def forward(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> list[Tensor]:
        """Map normalised states (B, S), words (B, L) and images to the hidden state (B, P, W) of every layer.

        Raises:
            InputError: There is no image (B, N, N, 3), uint8, of the size that the policy reads.
        """
        batch = len(state)
        observation = [self.observation(state).view(batch, self.state_tokens, -1)]
        if self.vision is not None:
            observation.append(self.vision(image))
        tokens = torch.cat([*observation, self.readout.expand(batch, -1, -1), self.words(words)], dim=1)
        tokens = tokens + self.position
        mask, hidden = self.mask(words), []
        for layer in self.layers:
            tokens = layer(tokens, mask)
            hidden.append(tokens)
        return hidden

    def answer_logits(self, hidden: Tensor) -> Tensor:
        """Map the last layer's hidden state (B, P, W) to the logits of the answer word (B, V)."""
        return cast(Tensor, self.answer(hidden[:, self.observation_tokens]))
