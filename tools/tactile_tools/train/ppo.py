"""Proximal policy optimisation of the residual on quick sweep, on PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from torch import nn

from reachd.strategies.learned import RESIDUAL_BOUND, Policy
from reachd.strategies.memory import DECISION_S, WIDTH
from tactile_tools.train.cupboards import PRIVILEGED, Turn
from tactile_tools.train.settings import Learning

ACTIONS: Final = 3


def network(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    """Fully connected layers with ELU between them; the last begins at zero."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU()]
        inputs = width
    last = nn.Linear(inputs, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)


class Noise:
    """Standard normal draws for (n, actions) residuals, a share of which lasts.

    Noise that is drawn anew ten times a second cancels before a finger has moved. Noise of which
    a part lasts explores better (Hollenstein et al. 2024, "Colored Noise in PPO"); each draw alone
    is standard normal, and counts as such. ``generator``: lies on the device that draws.
    """

    def __init__(self, n: int, lasting: float, lasts_s: float, generator: torch.Generator) -> None:
        self._generator, self._lasting = generator, lasting
        self._keeps = float(np.exp(-DECISION_S / lasts_s))
        self._slow = self._fresh(n)

    def _fresh(self, n: int) -> torch.Tensor:
        generator = self._generator
        return torch.randn((n, ACTIONS), generator=generator, device=generator.device)

    def draw(self) -> torch.Tensor:
        """The draws of the next decision."""
        n, keeps = len(self._slow), self._keeps
        self._slow = keeps * self._slow + (1.0 - keeps * keeps) ** 0.5 * self._fresh(n)
        slow, fast = self._lasting**0.5, (1.0 - self._lasting) ** 0.5
        mixed: torch.Tensor = slow * self._slow + fast * self._fresh(n)
        return mixed


@dataclass(slots=True)
class Batch:
    """What was seen and done in ``t`` decisions of ``n`` reaches: tensors (t, n, …)."""

    observations: torch.Tensor
    privileged: torch.Tensor
    actions: torch.Tensor
    chances: torch.Tensor  # logarithm of the density with which each action was drawn
    rewards: torch.Tensor
    ended: torch.Tensor
    values: torch.Tensor  # (t + 1, n)


class Learner:
    """Actor and critic, what they learn from a batch, and the state of both for a checkpoint."""

    def __init__(self, settings: Learning, device: str, seed: int) -> None:
        torch.manual_seed(seed)
        self.settings, self.device = settings, torch.device(device)
        hidden = tuple(settings.hidden)
        self.actor = network(WIDTH, hidden, ACTIONS).to(self.device)
        self.critic = network(WIDTH + PRIVILEGED, hidden, 1).to(self.device)
        self.spread = nn.Parameter(
            torch.full((ACTIONS,), float(np.log(settings.spread)), device=self.device)
        )
        self._parameters = [*self.actor.parameters(), *self.critic.parameters(), self.spread]
        self._optimiser = torch.optim.Adam(self._parameters, lr=settings.rate, eps=1e-5)
        self.rate = settings.rate

    def act(
        self, seen: torch.Tensor, privileged: torch.Tensor, draws: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Actions for (n, ·) observations with the `Noise` ``draws``, the logarithms of their
        densities, and values."""
        with torch.no_grad():
            chances = (-0.5 * draws**2 - self.spread - 0.9189385).sum(dim=1)
            actions = self.actor(seen) + self.spread.exp() * draws
            return actions, chances, self._value(seen, privileged)

    def mean(self, seen: torch.Tensor) -> torch.Tensor:
        """What the policy does without noise: residuals for (n, ·) observations."""
        with torch.no_grad():
            mean: torch.Tensor = self.actor(seen).clamp(-RESIDUAL_BOUND, RESIDUAL_BOUND)
        return mean

    def values(self, seen: torch.Tensor, privileged: torch.Tensor) -> torch.Tensor:
        """What the critic expects from (n, ·) observations on."""
        with torch.no_grad():
            return self._value(seen, privileged)

    def _value(self, seen: torch.Tensor, privileged: torch.Tensor) -> torch.Tensor:
        value: torch.Tensor = self.critic(torch.cat([seen, privileged], dim=1))[:, 0]
        return value

    def learn(self, batch: Batch, generator: torch.Generator) -> dict[str, float]:
        """Improve actor and critic by ``batch``; returns what there is to say of it."""
        s = self.settings
        advantages, returns = advantages_of(batch, s.discount, s.trace)
        flat = {
            "seen": batch.observations,
            "privileged": batch.privileged,
            "actions": batch.actions,
            "chances": batch.chances,
            "values": batch.values[:-1],
            "advantages": (advantages - advantages.mean()) / (advantages.std() + 1e-8),
            "returns": returns,
        }
        flat = {name: values.flatten(0, 1) for name, values in flat.items()}
        count = len(flat["returns"])
        drift, losses = 0.0, []
        for _ in range(s.epochs):
            order = torch.randperm(count, generator=generator, device=self.device)
            drift = 0.0
            for part in order.chunk(s.minibatches):
                loss, away = self._loss({name: values[part] for name, values in flat.items()})
                self._optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call, unused-ignore]
                nn.utils.clip_grad_norm_(self._parameters, s.clip_norm)
                self._optimiser.step()
                with torch.no_grad():
                    self.spread.clamp_(min=float(np.log(s.least_spread)))
                losses.append(float(loss.detach()))
                drift += float(away.detach()) / s.minibatches
            self._adapt(drift)
            if drift > 4 * s.drift:
                break
        return {
            "loss": float(np.mean(losses)),
            "drift": drift,
            "rate": self.rate,
            "spread": float(self.spread.detach().exp().mean()),
        }

    def _loss(self, part: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        s = self.settings
        mean = self.actor(part["seen"])
        normal = torch.distributions.Normal(mean, self.spread.exp())
        chances = normal.log_prob(part["actions"]).sum(dim=1)  # type: ignore[no-untyped-call, unused-ignore]
        change = chances - part["chances"]
        ratio = change.exp()
        gain = part["advantages"]
        clipped = ratio.clamp(1 - s.clip, 1 + s.clip)
        policy = -torch.minimum(ratio * gain, clipped * gain).mean()
        values = self._value(part["seen"], part["privileged"])
        near = part["values"] + (values - part["values"]).clamp(-0.5, 0.5)
        error = torch.maximum((values - part["returns"]) ** 2, (near - part["returns"]) ** 2)
        wide = (mean.abs() - RESIDUAL_BOUND).clamp(min=0).pow(2).sum(dim=1).mean()
        entropy = normal.entropy().sum(dim=1).mean()  # type: ignore[no-untyped-call, unused-ignore]
        away = (ratio - 1 - change).mean()  # of Kullback and Leibler, estimated
        return policy + 0.5 * error.mean() + wide - s.entropy * entropy, away

    def _adapt(self, drift: float) -> None:
        s = self.settings
        if drift > 2 * s.drift:
            self.rate = max(self.rate / 1.5, 1e-5)
        elif drift < s.drift / 2:
            self.rate = min(self.rate * 1.5, s.greatest_rate)
        for group in self._optimiser.param_groups:
            group["lr"] = self.rate

    def policy(self, about: dict[str, Any]) -> Policy:
        """The actor as plain arrays."""
        layers = [
            (
                layer.weight.detach().cpu().numpy().T.copy(),
                layer.bias.detach().cpu().numpy().copy(),
            )
            for layer in self.actor
            if isinstance(layer, nn.Linear)
        ]
        return Policy(tuple(layers), about)

    def state(self) -> dict[str, Any]:
        """Everything that a checkpoint keeps of it."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "spread": self.spread.detach(),
            "optimiser": self._optimiser.state_dict(),
            "rate": self.rate,
        }

    def adopt(self, state: dict[str, Any]) -> None:
        """Begin with the networks of another checkpoint's `state`, whatever their width.

        A layer that is wider here has the other's units, and more that are as yet without effect:
        the function is the same. ValueError where it does not fit.
        """
        with torch.no_grad():
            for network, theirs in ((self.actor, state["actor"]), (self.critic, state["critic"])):
                own = network.state_dict()
                if own.keys() != theirs.keys():
                    raise ValueError("it has another number of layers")
                layers = sorted({name.split(".")[0] for name in own}, key=int)
                known = own[f"{layers[0]}.weight"].shape[1]
                if theirs[f"{layers[0]}.weight"].shape[1] != known:
                    raise ValueError("it sees other observations")
                for layer in layers:
                    weight, offsets = own[f"{layer}.weight"], own[f"{layer}.bias"]
                    other = theirs[f"{layer}.weight"]
                    if other.shape[0] > weight.shape[0]:
                        raise ValueError(f"a layer of {other.shape[0]} is wider than here")
                    weight[: other.shape[0], known:] = 0.0  # of units that are new
                    weight[: other.shape[0], :known] = other
                    offsets[: other.shape[0]] = theirs[f"{layer}.bias"]
                    known = other.shape[0]
                network.load_state_dict(own)

    def load(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint's `state`."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        with torch.no_grad():
            self.spread.copy_(state["spread"])
        self._optimiser.load_state_dict(state["optimiser"])
        self.rate = float(state["rate"])


def advantages_of(batch: Batch, discount: float, trace: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Generalised advantages (Schulman et al. 2016, equation 16) and returns, (t, n) each."""
    advantages = torch.zeros_like(batch.rewards)
    following = torch.zeros_like(batch.rewards[0])
    for k in range(len(batch.rewards) - 1, -1, -1):
        goes_on = (~batch.ended[k]).float()
        error = batch.rewards[k] + discount * goes_on * batch.values[k + 1] - batch.values[k]
        following = error + discount * trace * goes_on * following
        advantages[k] = following
    return advantages, advantages + batch.values[:-1]


Seen = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, Turn]
"""Observations, privileged, actions, chances, values of a decision, and what it led to."""


def gather(turns: list[Seen], last_values: torch.Tensor) -> Batch:
    """A batch of decisions, in order."""
    return Batch(
        torch.stack([t[0] for t in turns]),
        torch.stack([t[1] for t in turns]),
        torch.stack([t[2] for t in turns]),
        torch.stack([t[3] for t in turns]),
        torch.stack([t[5].rewards for t in turns]),
        torch.stack([t[5].ended for t in turns]),
        torch.stack([*(t[4] for t in turns), last_values]),
    )
