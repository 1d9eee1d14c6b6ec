# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of the diffusion providers, checked without loading anything. Standard library only.

Blender's own Python builds its panel from these, the command line checks against them, and the worker reads them.
A provider adds a dataclass and a line in `PROVIDER_OPTIONS`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from ..errors import InputError
from .model_files import is_hub_id

NOT_AN_OPTION = "allow_download"
"""gskin 0.1.0 wrote the person's consent among the options; see `consent.py`."""
OFFLOADS = ("auto", "none", "model", "sequential")
DTYPES = ("auto", "float32", "float16", "bfloat16")
LCM_STEPS = 50
"""As many as an LCM LoRA was distilled from."""


def ranged(default: Any, low: float, high: float) -> Any:
    """A number of a settings dataclass that must lie in [low, high]."""
    return field(default=default, metadata={"range": (low, high)})


def one_of(default: str, choices: tuple[str, ...]) -> Any:
    """A word of a settings dataclass that must be one of `choices`."""
    return field(default=default, metadata={"choices": choices})


def unseen(default: Any, **metadata: Any) -> Any:
    """A setting that does not change the pictures: how, not what, is computed."""
    return field(default=default, metadata={**metadata, "unseen": True})


def place() -> Any:
    """A folder or hub id of a settings dataclass, empty for none."""
    return field(default="", metadata={"place": True})


@dataclass(frozen=True)
class DiffusionOptions:
    """Settings that all diffusion providers have.

    device: "auto" or a torch device; dtype: of the weights, "auto" for the device's best; offload: "none" keeps all
    weights on the device, "model" one model at a time, "sequential" one layer at a time; batch: images at once, 0 for
    what fits the memory; steps: denoising steps, 0 for the model's own.
    """

    device: str = unseen("auto")
    dtype: str = one_of("auto", DTYPES)
    offload: str = unseen("auto", choices=OFFLOADS)
    batch: int = unseen(0, range=(0, 64))
    steps: int = ranged(0, 0, 1000)

    @classmethod
    def parse(cls, values: Mapping[str, Any], guidance: str) -> Self:
        """Settings from a job's `options`; whole numbers stand for decimal ones too.

        Raises:
            InputError: an unknown name, a wrong type, or a value that is not allowed.
        """
        if NOT_AN_OPTION in values:
            raise InputError(
                f"'{NOT_AN_OPTION}' is no option of '{guidance}': nobody's files agree to a download; remove it there, "
                "and agree when you start (the add-on's tick, or --allow-download)."
            )
        known = {f.name: f for f in dataclasses.fields(cls)}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise InputError(
                f"The guidance '{guidance}' has no option '{unknown[0]}'; it knows {', '.join(sorted(known))}."
            )
        chosen = cls(**{name: _checked(known[name], value, guidance) for name, value in values.items()})
        chosen.check(guidance)
        return chosen

    def check(self, guidance: str) -> None:
        """Raise InputError for settings that each are allowed, but not together."""

    def identity(self) -> dict[str, Any]:
        """The settings that decide what the pictures look like, as plain values."""
        return {
            f.name: getattr(self, f.name) for f in dataclasses.fields(self) if not f.metadata.get("unseen")
        }

    def models_named(self) -> dict[str, str]:
        """What each model is, and the folder or hub id given for it, empty where none is."""
        return {}


@dataclass(frozen=True)
class KleinOptions(DiffusionOptions):
    """Settings of what runs FLUX.2 [klein].

    model: folder of a FLUX.2 [klein] pipeline in the diffusers layout, or a hub id, `owner/name` or
    `owner/name@revision`; prompt: what is asked for, with "{subject}" for `subject`; guidance_scale: of the prompt,
    only for undistilled models.
    """

    model: str = place()
    prompt: str = ""
    subject: str = "character"
    guidance_scale: float = ranged(4.0, 1.0, 30.0)

    def models_named(self) -> dict[str, str]:
        """See DiffusionOptions."""
        return {"FLUX.2 [klein] model": self.model.strip()}


@dataclass(frozen=True)
class FluxOptions(KleinOptions):
    """Settings of `flux_repair`.

    strength: how much of the noise schedule is run, 1 forgets the posed render's pixels inside the mask.
    """

    prompt: str = (
        "The {subject} of the second image in the pose of the first image. Same colours, same materials, intact "
        "limbs and joints, plain white background."
    )
    strength: float = ranged(0.6, 0.01, 1.0)


@dataclass(frozen=True)
class Flux2Options(KleinOptions):
    """Settings of `flux2`.

    lora: folder with the LoRA that `train-guidance tune --model flux2` wrote, empty for the model as it is;
    batch: the pipeline takes the references of one image at a time.
    """

    prompt: str = (
        "The {subject} of the first image, moved from the skeleton of the second image to the skeleton of the third "
        "image. Same colours, same materials, intact limbs and joints, plain white background."
    )
    lora: str = place()
    batch: int = unseen(0, range=(0, 1))

    def models_named(self) -> dict[str, str]:
        """See DiffusionOptions."""
        tuned = {"LoRA for FLUX.2 [klein]": self.lora.strip()} if self.lora.strip() else {}
        return {**super().models_named(), **tuned}


@dataclass(frozen=True)
class LightningDragOptions(DiffusionOptions):
    """Settings of `lightning_drag`.

    models: a folder that holds one folder per role (`base`, `vae`, `ip_adapter`, `lightning_drag`, and `lcm_lora`
    where wanted); base, vae, ip_adapter, lightning_drag, lcm_lora: a folder or hub id of its own for a role;
    scheduler: "lcm" needs the LCM LoRA; guidance_scale: of the control points, 0 for the scheduler's own;
    max_points: control points kept by farthest-point sampling, 0 for all, -1 for what the checkpoint was trained on
    (20 for the published one, which fails on dense points).
    """

    # Its attentions hold weights of their own, which off-loading layer by layer would leave behind.
    offload: str = unseen("auto", choices=("auto", "none", "model"))
    # With more, diffusers' DDIM would begin in the midst of the noise.
    steps: int = ranged(0, 0, 500)

    models: str = place()
    base: str = place()
    vae: str = place()
    ip_adapter: str = place()
    lightning_drag: str = place()
    lcm_lora: str = place()
    scheduler: str = one_of("lcm", ("lcm", "ddim"))
    guidance_scale: float = ranged(0.0, 0.0, 30.0)
    max_points: int = ranged(-1, -1, 512)

    def check(self, guidance: str) -> None:
        """See DiffusionOptions."""
        if self.scheduler == "lcm" and self.steps > LCM_STEPS:
            raise InputError(
                f"The option steps of '{guidance}' is {self.steps}; the scheduler lcm takes {LCM_STEPS} at most, "
                "so choose fewer, or the scheduler ddim."
            )

    def models_named(self) -> dict[str, str]:
        """See DiffusionOptions; a role without a name of its own lies in its folder of `models`."""
        roles = {
            "base": "base inpainting model",
            "vae": "VAE",
            "ip_adapter": "IP-Adapter",
            "lightning_drag": "LightningDrag checkpoint",
            **({"lcm_lora": "LCM-LoRA"} if self.scheduler == "lcm" else {}),
        }
        inside = Path(self.models).expanduser() if self.models.strip() else None
        return {
            words: getattr(self, role).strip() or (str(inside / role) if inside is not None else "")
            for role, words in roles.items()
        }


PROVIDER_OPTIONS: dict[str, type[DiffusionOptions]] = {
    "flux2": Flux2Options,
    "flux_repair": FluxOptions,
    "lightning_drag": LightningDragOptions,
}


def check_options(guidance: str, values: Mapping[str, Any]) -> None:
    """Raise InputError unless `values` are options of `guidance`; providers not listed here check their own."""
    if not isinstance(values, Mapping):
        raise InputError(f"The options of the guidance are {values!r}; they must be a table of names and values.")
    if guidance in PROVIDER_OPTIONS:
        PROVIDER_OPTIONS[guidance].parse(values, guidance)


def deciding(settings: Mapping[str, Any]) -> dict[str, Any]:
    """A job's settings without those that do not change its result: device, batches."""
    options, kind = settings.get("options"), PROVIDER_OPTIONS.get(str(settings.get("guidance")))
    if kind is None or not isinstance(options, Mapping):
        return dict(settings)
    unseen_names = {f.name for f in dataclasses.fields(kind) if f.metadata.get("unseen")}
    return {**settings, "options": {name: value for name, value in options.items() if name not in unseen_names}}


def with_absolute_folders(guidance: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The options with local folders as absolute paths, for a worker that may start elsewhere."""
    kind = PROVIDER_OPTIONS.get(guidance)
    places = {f.name for f in dataclasses.fields(kind) if f.metadata.get("place")} if kind else set()
    return {
        name: str(Path(value).expanduser().absolute())
        if name in places and isinstance(value, str) and value.strip() and not is_hub_id(value)
        else value
        for name, value in values.items()
    }


def check_models(guidance: str, values: Mapping[str, Any]) -> None:
    """Raise InputError unless every model of `guidance` is named, and every folder named is there.

    Looks at names and folders only; the worker looks into them.
    """
    if guidance not in PROVIDER_OPTIONS:
        return
    for words, name in PROVIDER_OPTIONS[guidance].parse(values, guidance).models_named().items():
        if not name:
            raise InputError(f"No {words} is named: give its folder or a hub id in the settings of the guidance.")
        if not is_hub_id(name) and not Path(name).expanduser().is_dir():
            raise InputError(f"The folder of the {words}, '{name}', does not exist; correct the path.")


def _checked(f: dataclasses.Field[Any], value: Any, guidance: str) -> Any:
    kind = type(f.default)
    if kind is float and type(value) is int and abs(value) < 2**63:
        value = float(value)
    if type(value) is not kind:
        words = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
        raise InputError(f"The option {f.name} of '{guidance}' is {value!r}; it must be {words[kind]}.")
    choices, limits = f.metadata.get("choices"), f.metadata.get("range")
    if choices and value not in choices:
        raise InputError(
            f"The option {f.name} of '{guidance}' is '{value}'; choose one of {', '.join(choices)}."
        )
    if limits and not limits[0] <= value <= limits[1]:
        raise InputError(
            f"The option {f.name} of '{guidance}' is {value}; it must lie between {limits[0]} and {limits[1]}."
        )
    return value
