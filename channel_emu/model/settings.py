"""The scenario's ``channel:`` section as settings with all defaults.

Rates are per millisecond and delays in milliseconds, as in the thesis. A value that may depend on
the chain's state is one number, or a list with one entry a state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, field
from msgspec.structs import replace
from numpy.typing import NDArray

from channel_emu.model import faults as fault_modules
from channel_emu.model import notation
from channel_emu.model.chain import ChainError, check_generator, stationary, two_state_generator
from channel_emu.model.faults import per_state
from channel_emu.model.link import Discipline
from channel_emu.model.presets import preset
from freshfield.plugins import PluginError
from freshfield.settings import ScenarioError, Settings, about, as_mapping, read_settings, within

NotNegative = Annotated[float, Meta(ge=0)]
NOTATIONS = ("arrivals", "service", "chain")
"""Keys that may be written as on the command line (``exp:60ms``)."""


class ArrivalsConfig(Settings, frozen=True):
    """When frames enter the link.

    as-offered: whenever the camera offers one.
    periodic: one every ``period_ms`` in simulations; on a live link, where the camera sets the period, the
        same as as-offered.
    poisson: a Poisson process samples the newest offered frame; with one rate a chain state it is an MMPP.
    """

    process: Literal["as-offered", "periodic", "poisson"] = "as-offered"
    period_ms: Annotated[float, within(1e-3, math.inf, "of periodic arrivals")] | None = None
    rate_per_ms: Annotated[NotNegative | list[NotNegative] | None, about("of poisson; one, or one a state")] = None

    def __post_init__(self) -> None:
        _belongs("period_ms", self.period_ms, self.process == "periodic", "process periodic")
        _belongs("rate_per_ms", self.rate_per_ms, self.process == "poisson", "process poisson")
        if self.rate_per_ms is not None and not any(per_state(self.rate_per_ms)):
            raise ValueError("rate_per_ms: expected a rate above 0 in at least one state")


class ChainConfig(Settings, frozen=True):
    """The Markov chain of the network's state (6.25).

    generator_per_ms: instead of the two rates, row by row.
    scope: ``shared`` by all cameras, or ``per-camera``: an independent chain for each.
    """

    mu1_per_ms: Annotated[NotNegative | None, about("rate of leaving the first of two states (6.26)")] = None
    mu2_per_ms: Annotated[NotNegative | None, about("rate of leaving the second")] = None
    generator_per_ms: Annotated[list[list[float]] | None, about("(M, M), of any number of states")] = None
    states: Annotated[list[str], about("names of the states; not given: s1, s2, ...")] = field(default_factory=list)
    initial: Annotated[str | None, about("first state; not given: drawn from the stationary distribution")] = None
    scope: Literal["shared", "per-camera"] = "shared"

    def __post_init__(self) -> None:
        pair = (self.mu1_per_ms is not None) + (self.mu2_per_ms is not None)
        if pair != (0 if self.generator_per_ms is not None else 2):
            raise ValueError("expected mu1_per_ms and mu2_per_ms, or generator_per_ms")
        try:
            generator = self.generator()
        except ValueError as error:
            raise ValueError(f"generator_per_ms: {error}") from None
        if len(set(self.names())) != len(generator) or len(self.names()) != len(generator):
            raise ValueError(f"states: expected {len(generator)} different names, got {', '.join(self.states)}")
        if self.initial is None:
            try:
                stationary(generator)
            except ChainError as error:
                raise ValueError(f"initial: {error}") from None
        elif self.initial not in self.names():
            raise ValueError(f"initial: expected one of {', '.join(self.names())}, got {self.initial!r}")

    def generator(self) -> NDArray[np.float64]:
        """Q in 1/ms, (M, M)."""
        if self.generator_per_ms is None:
            return two_state_generator(self.mu1_per_ms or 0.0, self.mu2_per_ms or 0.0)
        if len({len(row) for row in self.generator_per_ms} | {len(self.generator_per_ms)}) != 1:
            raise ValueError("expected a square matrix, row by row")
        return check_generator(np.array(self.generator_per_ms, float))

    def names(self) -> list[str]:
        count = 2 if self.generator_per_ms is None else len(self.generator_per_ms)
        return self.states or [f"s{i + 1}" for i in range(count)]


class ServiceConfig(Settings, frozen=True):
    """The distribution of service times: how long the link takes to transmit a frame.

    law: of the delays. mean_ms: of all but none and trace.
    shape: the coefficient of variation is 1/sqrt(shape).
    delays_ms: used in turn and repeated from the start after the last.
    """

    law: Literal["none", "exponential", "deterministic", "gamma", "lognormal", "trace"] = "none"
    mean_ms: Annotated[NotNegative | list[NotNegative] | None, about("mean; one, or one a state")] = None
    shape: Annotated[float, within(1e-3, 1e6, "of gamma")] | None = None
    sigma: Annotated[float, within(0, 10, "of lognormal: standard deviation of the logarithm")] | None = None
    delays_ms: Annotated[list[NotNegative], Meta(min_length=1, description="of trace")] | None = None

    def __post_init__(self) -> None:
        _belongs("mean_ms", self.mean_ms, self.law not in ("none", "trace"), "a distribution with a mean")
        _belongs("shape", self.shape, self.law == "gamma", "law gamma")
        _belongs("sigma", self.sigma, self.law == "lognormal", "law lognormal")
        _belongs("delays_ms", self.delays_ms, self.law == "trace", "law trace")


class ServerConfig(Settings, frozen=True):
    """shared: all cameras compete for one server (``queue_server`` explains the disciplines); otherwise each
    has its own. Cameras that capture at the same instant arrive in the order of their names, so under
    drop-new the first of them is served."""

    shared: bool = False


class ChannelConfig(Settings, frozen=True):
    """The whole ``channel:`` section; ``presets`` holds the channels of the thesis.

    service_state: at-start: the state in which transmission starts sets the mean delay. modulated: the service rate
        follows the chain's state during transmission.
    queue_limit: bounds memory; for all cameras together if the server is shared.
    """

    preset: str | None = None
    arrivals: ArrivalsConfig = field(default_factory=ArrivalsConfig)
    chain: ChainConfig | None = None
    service: ServiceConfig = field(default_factory=ServiceConfig)
    service_state: Literal["at-start", "modulated"] = "at-start"
    discipline: Discipline = "drop-new"
    server: ServerConfig = field(default_factory=ServerConfig)
    queue_limit: Annotated[int, within(1, 10**6, "frames waiting (fcfs) or in service (parallel)")] = 1024
    faults: Annotated[dict[str, Any], about("parameters of the listed faults, by name")] = field(default_factory=dict)

    def __post_init__(self) -> None:
        states = 1 if self.chain is None else len(self.chain.names())
        chances = {f"faults.{name}.probability": getattr(p, "probability", None) for name, p in self.faults.items()}
        by_state = {
            "arrivals.rate_per_ms": self.arrivals.rate_per_ms,
            "service.mean_ms": self.service.mean_ms,
            **chances,
        }
        for key, value in by_state.items():
            if isinstance(value, list) and len(value) != states:
                what = "there is no chain" if self.chain is None else f"the chain has {states} states"
                raise ValueError(f"{key}: expected one number or one a state, got {len(value)}; {what}")

    @property
    def state_names(self) -> list[str]:
        return ["-"] if self.chain is None else self.chain.names()

    @property
    def mean_delay_ms(self) -> float:
        """Mean service time; if it depends on the state, weighted by the states' long-run shares."""
        service = self.service
        if service.mean_ms is None:
            return float(np.mean(service.delays_ms or [0.0]))
        means = per_state(service.mean_ms)
        if len(means) == 1 or self.chain is None:
            return means[0]
        return float(stationary(self.chain.generator()) @ means)

    def to_mapping(self) -> dict[str, Any]:
        """The resolved section: reading it again gives this configuration."""
        return {key: value for key, value in as_mapping(self).items() if key != "preset"}


def channel_from_mapping(
    mapping: Any, where: str = "channel", folder: Path = Path(), cameras: Sequence[str] = ()
) -> ChannelConfig:
    """Read a ``channel:`` section; an empty one is the ideal channel.

    Keys beside ``preset`` override the preset's. Mappings are merged key by key, but one that names another
    process or law replaces the preset's as a whole. ``arrivals``, ``service`` and ``chain`` may be written as
    on the command line (``notation``), and a fault as the value of its first parameter.

    where: what error messages call the section. folder: what file names in the section are relative to.
    cameras: those of the scenario, which a blackout may name; not given: any.
    Raises ScenarioError (a ValueError), one line that names the key.
    """
    if mapping is None:
        mapping = {}
    if not isinstance(mapping, dict):
        raise ScenarioError(f"{where}: expected a mapping, got {mapping!r}")
    name = mapping.get("preset", "ideal")
    try:
        merged = preset(name if isinstance(name, str) else repr(name))
    except ValueError as error:
        raise ScenarioError(f"{where}.preset: {error}") from None
    for key, value in mapping.items():
        value = from_notation(key, value, where, folder)
        base = from_notation(key, merged.get(key))
        merged[key] = _merge(base, value) if isinstance(base, dict) and isinstance(value, dict) else value
    merged = {key: from_notation(key, value) for key, value in merged.items()} | {"preset": name}
    faults = _read_faults(merged.pop("faults", None) or {}, f"{where}.faults")
    if strange := [name for name in getattr(faults.get("blackout"), "cameras", ()) if cameras and name not in cameras]:
        raise ScenarioError(
            f"{where}.faults.blackout.cameras: {strange[0]!r} is not one of the scenario's: {', '.join(cameras)}"
        )
    config = read_settings(ChannelConfig, merged, where)
    try:
        return replace(config, faults=faults)
    except ValueError as error:
        raise ScenarioError(f"{where}: {error}") from None


def from_notation(key: Any, value: Any, where: str = "channel", folder: Path = Path()) -> Any:
    """The value of a key of the section, in the short notation (``exp:60ms``) replaced by its mapping.

    Other values are returned unchanged. Raises ScenarioError.
    """
    if key not in NOTATIONS or not isinstance(value, str):
        return value
    try:
        if key == "service":
            return notation.service(value, folder)
        return notation.arrivals(value) if key == "arrivals" else notation.chain(value)
    except ValueError as error:
        raise ScenarioError(f"{where}.{key}: {error}") from None


def _merge(base: dict[str, Any], value: dict[str, Any]) -> dict[str, Any]:
    for kind in ("process", "law"):
        if kind in value and value[kind] != base.get(kind):
            return value
    if "generator_per_ms" in value:
        base = {k: v for k, v in base.items() if k not in ("mu1_per_ms", "mu2_per_ms", "states")}
    return {**base, **value}


def _read_faults(faults: Any, where: str) -> dict[str, Any]:
    if not isinstance(faults, dict):
        raise ScenarioError(f"{where}: expected a mapping of faults, got {faults!r}")
    read: dict[str, Any] = {}
    for name, params in faults.items():
        try:
            kind = fault_modules.params_class(name)
        except PluginError as error:
            raise ScenarioError(f"{where}.{name}: {error}") from None
        if not isinstance(params, dict):  # the first parameter alone: loss: 0.1
            params = {kind.__struct_fields__[0]: params}
        read[name] = read_settings(kind, params, f"{where}.{name}")
    return read


def _belongs(key: str, value: Any, wanted: bool, owner: str) -> None:
    if value is None and wanted:
        raise ValueError(f"{key}: missing ({owner} needs it)")
    if value is not None and not wanted:
        raise ValueError(f"{key}: belongs to {owner} only")
