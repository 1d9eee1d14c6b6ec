# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import pytest
import worker_jobs as jobs
from without import output_without

from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.options import FluxOptions, check_options
from gskin_addon.core.job.contract import fingerprint
from gskin_addon.core.job.settings import JobSettings


def test_values_keep_their_types_and_whole_numbers_may_be_decimal():
    options = FluxOptions.parse({"model": "a/b", "strength": 1, "steps": 4}, "flux_repair")
    assert options == FluxOptions(model="a/b", strength=1.0, steps=4)
    assert type(options.strength) is float


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"speed": 1}, "no option 'speed'; it knows .*strength"),
        ({"strength": 1.5}, "strength .* between 0.01 and 1.0"),
        ({"strength": "high"}, "must be a number"),
        ({"steps": 4.5}, "must be a whole number"),
        ({"steps": True}, "must be a whole number"),
        ({"allow_download": True}, "'allow_download' is no option .*agree when you start"),
        ({"strength": 10**400}, "must be a number"),
        ({"model": 3}, "must be text"),
        ({"offload": "disk"}, "choose one of auto, none"),
        (["model"], "must be a table"),
    ],
)
def test_wrong_options_are_one_sentence(values, words):
    with pytest.raises(InputError, match=words):
        check_options("flux_repair", values)


@pytest.mark.parametrize(("scheduler", "most"), [("lcm", 50), ("ddim", 500)])
def test_steps_that_the_scheduler_does_not_have_are_refused(scheduler, most):
    """diffusers' LCM stops at more, its DDIM begins in the midst of the noise, whatever the latents are."""
    check_options("lightning_drag", {"scheduler": scheduler, "steps": most})
    with pytest.raises(InputError, match=f"steps of 'lightning_drag' is {most + 1}"):
        check_options("lightning_drag", {"scheduler": scheduler, "steps": most + 1})


def test_what_does_not_change_the_pictures_is_not_part_of_their_identity():
    here = FluxOptions(model="a", device="cpu", batch=1).identity()
    there = FluxOptions(model="a", device="cuda", batch=4, offload="model").identity()
    assert here == there
    assert here != FluxOptions(model="b").identity()


def test_a_job_with_wrong_options_is_refused_before_any_work():
    with pytest.raises(InputError, match="strength"):
        JobSettings.parse({"guidance": "flux_repair", "options": {"strength": 2}})
    JobSettings.parse({"guidance": "elastic", "options": {"anything": 1}})


def test_the_same_job_with_another_device_goes_on():
    def job(guidance, **options):
        return fingerprint(*jobs.rod(50), {"guidance": guidance, "options": options})

    assert job("flux_repair", model="a") == job("flux_repair", model="a", device="cuda", batch=2)
    assert job("flux_repair", model="a") != job("flux_repair", model="b")
    assert job("oracle", device="a") != job("oracle", device="b")


def test_blenders_own_python_can_read_them():
    code = (
        "from gskin_addon.core.guidance.options import PROVIDER_OPTIONS\n"
        "from gskin_addon.core.guidance import model_files\n"
        "print(*PROVIDER_OPTIONS)\n"
    )
    heavy = ("numpy", "scipy", "numba", "torch", "PIL", "diffusers")
    assert "flux_repair" in output_without(heavy, code).split()
