# SPDX-License-Identifier: GPL-3.0-or-later
"""What the person brings: complete and right, or refused by name."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

pytest.importorskip("diffusers")

from diffusers import StableDiffusionPipeline
from safetensors.torch import load_file, save_file

from gskin_addon.core.errors import InputError
from gskin_addon.core.guidance.lightning_drag.files import find_files
from gskin_addon.core.guidance.lightning_drag.lora import merge_lora
from gskin_addon.core.guidance.lightning_drag.point_embedding import PointEmbedding
from gskin_addon.core.guidance.lightning_drag.processors import install
from gskin_addon.core.guidance.lightning_drag.weights import (
    load,
    load_appearance,
    load_attention,
    load_image_tokens,
    load_point_embedding,
    read_ip_adapter,
)
from gskin_addon.core.guidance.model_files import load_tensors
from gskin_addon.core.guidance.options import LightningDragOptions
from gskin_addon.core.training.guidance.tune_state import write_checkpoint
from tests.helpers.tiny_lightning import CLIP_WIDTH, CONTEXT, POINT_WIDTH, kohya_lora, tiny_unet

ENCODER = "lightning_drag/appearance_encoder/diffusion_pytorch_model.safetensors"
POINTS = "lightning_drag/point_embedding/point_embedding.pt"
ATTENTION = "lightning_drag/lightning-drag-sd15-attn.bin"
ADAPTER = "ip_adapter/models/ip-adapter_sd15.bin"
LORA = "lcm_lora/pytorch_lora_weights.safetensors"
UNET = "base/unet/diffusion_pytorch_model.safetensors"


EMBEDDINGS = PointEmbedding(POINT_WIDTH).embeddings


@pytest.fixture(scope="module")
def unet():
    """A denoising UNet that nothing is left in by the tests that are refused."""
    return tiny_unet(9)


@pytest.fixture
def mine(models, tmp_path):
    """A copy of the models that may be spoilt."""
    return shutil.copytree(models, tmp_path / "models")


def load_all(folder, **options):
    return load(find_files(LightningDragOptions(models=str(folder), **options)), torch.float32)


def test_every_tensor_comes_from_its_file(models):
    model = load_all(models, scheduler="ddim")
    attention = torch.load(models / ATTENTION, weights_only=True)
    adapter = torch.load(models / ADAPTER, weights_only=True)
    state = model.processors.state_dict()
    for key, tensor in state.items():
        source = adapter["ip_adapter"] if "_ip." in key else attention  # the adapter's overrides
        torch.testing.assert_close(tensor, source[key], rtol=0, atol=0)
    assert not torch.equal(attention["1.to_k_ip.weight"], adapter["ip_adapter"]["1.to_k_ip.weight"])
    assert model.appearance.state_dict().keys() == load_file(models / ENCODER).keys()
    assert not any(parameter.is_meta for parameter in model.appearance.parameters())
    base = load_file(models / UNET)
    for key, tensor in base.items():
        torch.testing.assert_close(model.unet.state_dict()[key], tensor, rtol=0, atol=0)
    assert model.text.shape == (1, 77, CONTEXT)
    assert list(model.image_tokens.state_dict()) == ["proj.weight", "proj.bias", "norm.weight", "norm.bias"]


def test_the_empty_prompt_is_a_start_and_ends(models):
    from transformers import CLIPTextModel

    encoder = CLIPTextModel.from_pretrained(models / "base/text_encoder")
    with torch.no_grad():
        states = encoder(torch.tensor([[6] + [7] * 76]))[0]
    torch.testing.assert_close(load_all(models, scheduler="ddim").text, states)


def test_lora_is_merged_for_lcm_only(models):
    place = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q.weight"
    lora, base = load_file(models / LORA), load_file(models / UNET)[place]
    stem = "lora_unet_" + place.removesuffix(".weight").replace(".", "_")
    change = 0.5 * lora[f"{stem}.lora_up.weight"] @ lora[f"{stem}.lora_down.weight"]  # alpha 1, rank 2
    merged = load_all(models, scheduler="lcm").unet.state_dict()[place]
    torch.testing.assert_close(merged, base + change)
    torch.testing.assert_close(load_all(models, scheduler="ddim").unet.state_dict()[place], base)


@torch.no_grad()
def test_merging_equals_what_diffusers_does_with_peft():
    pytest.importorskip("peft")
    torch.manual_seed(0)
    ours, theirs = tiny_unet(9), tiny_unet(9)
    theirs.load_state_dict(ours.state_dict())
    latents, text = torch.randn(2, 9, 8, 8), torch.randn(2, 77, CONTEXT)
    before = ours(latents, 100, text)[0]
    lora = kohya_lora(ours)
    state, alphas = StableDiffusionPipeline.lora_state_dict({key: tensor.clone() for key, tensor in lora.items()})
    StableDiffusionPipeline.load_lora_into_unet(state, alphas, unet=theirs)
    assert merge_lora(ours, lora, "The LoRA") == 7
    after = ours(latents, 100, text)[0]
    torch.testing.assert_close(after, theirs(latents, 100, text)[0], atol=2e-6, rtol=1e-5)
    assert (after - before).abs().max() > 1e-3


def test_a_lora_in_diffusers_names_is_merged_alike():
    torch.manual_seed(0)
    ours, theirs = tiny_unet(9), tiny_unet(9)
    theirs.load_state_dict(ours.state_dict())
    lora = kohya_lora(ours)
    flat = {name.replace(".", "_"): name for name, _ in ours.named_modules()}
    renamed = {}
    for key, tensor in lora.items():
        stem, _, end = key.removeprefix("lora_unet_").partition(".")
        if end != "alpha":
            renamed[f"unet.{flat[stem]}.{'lora_A' if 'down' in end else 'lora_B'}.weight"] = tensor
    same = {key: torch.tensor(2.0) if key.endswith("alpha") else tensor for key, tensor in lora.items()}
    merge_lora(ours, renamed, "The LoRA")
    merge_lora(theirs, same, "The LoRA")
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("gone", "words"),
    [
        (UNET, "base inpainting model .* lacks 'unet/diffusion_pytorch_model.safetensors"),
        ("base/tokenizer/vocab.json", "lacks 'tokenizer/vocab.json'"),
        ("vae/config.json", "VAE .* lacks 'config.json'"),
        ("ip_adapter/models/image_encoder/model.safetensors", "IP-Adapter .* lacks 'models/image_encoder"),
        (ENCODER, "LightningDrag checkpoint .* lacks 'appearance_encoder"),
        (POINTS, "lacks 'point_embedding/point_embedding.pt'"),
        (ATTENTION, "lacks 'lightning-drag-sd15-attn.bin'"),
        (LORA, "LCM-LoRA .* lacks 'pytorch_lora_weights.safetensors'"),
    ],
)
def test_missing_files_are_named(mine, gone, words):
    (mine / gone).unlink()
    with pytest.raises(InputError, match=words):
        load_all(mine)


def test_ddim_needs_no_lora(mine):
    shutil.rmtree(mine / "lcm_lora")
    load_all(mine, scheduler="ddim")
    with pytest.raises(InputError, match="folder of the LCM-LoRA"):
        load_all(mine)


def test_nothing_named_says_where_to_get_it():
    with pytest.raises(InputError, match=r"No base inpainting model is named.*dreamshaper-8-inpainting.*OpenRAIL"):
        find_files(LightningDragOptions())


def edit_config(path, **values):
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_a_base_model_without_inpainting_is_refused(mine):
    edit_config(mine / "base/unet/config.json", in_channels=4)
    with pytest.raises(InputError, match="no inpainting model: its UNet takes 4 channels, not 9"):
        load_all(mine)


def test_a_base_model_of_another_family_is_refused(mine):
    edit_config(mine / "base/unet/config.json", use_linear_projection=True)
    with pytest.raises(InputError, match=r"not of the family of Stable Diffusion 1\.5"):
        load_all(mine)


def test_a_base_model_that_predicts_velocity_is_refused(mine):
    edit_config(mine / "base/scheduler/scheduler_config.json", prediction_type="v_prediction")
    with pytest.raises(InputError, match="predicts v_prediction, not epsilon"):
        load_all(mine)


def spoil(path, change):
    read, write = (load_file, save_file) if path.suffix == ".safetensors" else (torch.load, torch.save)
    state = read(path)
    change(state)
    write(state, path)


def rename(old, new):
    return lambda state: state.update({new: state.pop(old)})


def reshape(key, shape):
    return lambda state: state.update({key: torch.zeros(shape)})


def read_one(folder, file, unet):
    """Load what `file` belongs to, as `load` does, without the rest where that is not needed."""
    path = folder / file
    if file == POINTS:
        load_point_embedding(path)
    elif file == ENCODER:
        load_appearance(path.parent, unet.config, torch.float32)
    elif file == LORA:
        merge_lora(unet, load_tensors(path, "LCM-LoRA"), f"The LCM-LoRA '{path}'")
    elif file == ADAPTER:
        load_image_tokens(read_ip_adapter(path, install(unet, EMBEDDINGS)), CLIP_WIDTH, CONTEXT)
    elif file == ATTENTION:
        processors = install(unet, EMBEDDINGS)
        load_attention(path, processors, read_ip_adapter(folder / ADAPTER, processors))
    else:
        load_all(folder)


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        (UNET, lambda s: s.pop("conv_in.bias"), "UNet.*conv_in.bias"),
        (UNET, reshape("conv_in.weight", (8, 4, 3, 3)), "base model's UNet"),
        ("vae/diffusion_pytorch_model.safetensors", lambda s: s.pop("encoder.conv_in.bias"), "VAE.*conv_in.bias"),
        (
            "base/text_encoder/model.safetensors",
            lambda s: s.pop(next(key for key in s if "final_layer_norm.bias" in key)),
            "text encoder .* lacks the tensor '.*final_layer_norm.bias'",
        ),
        (
            "ip_adapter/models/image_encoder/model.safetensors",
            lambda s: s.pop("visual_projection.weight"),
            "image encoder .* lacks the tensor 'visual_projection.weight'",
        ),
        (POINTS, lambda s: s.pop("downsample_blocks_unet.2.conv2.weight"), "point embedding .* lacks the tensor"),
        (POINTS, rename("conv_in.weight", "module.conv_in.weight"), "lacks the tensor 'conv_in.weight'"),
        (ATTENTION, lambda s: s.pop("30.proj.weight"), "attention weights .* lacks the tensor '30.proj.weight'"),
        (ATTENTION, reshape("0.proj.weight", (8, 9)), "'0.proj.weight' as \\(8, 9\\), but .* need \\(8, 8\\)"),
        (ATTENTION, reshape("32.proj.weight", (8, 8)), "a tensor '32.proj.weight' that does not belong there"),
        (ADAPTER, lambda s: s["ip_adapter"].pop("31.to_v_ip.weight"), "IP-Adapter .* lacks .*'31.to_v_ip.weight'"),
        (ADAPTER, lambda s: s["image_proj"].update(latents=torch.zeros(1)), "'latents' that does not belong"),
        (ADAPTER, rename("image_proj", "projection"), "has 'projection', which does not belong there"),
        (ENCODER, lambda s: s.pop("conv_in.bias"), "appearance encoder .* lacks the tensor 'conv_in.bias'"),
        (ENCODER, reshape("conv_norm_out.bias", (8,)), "has the tensor 'conv_norm_out.bias', unlike LightningDrag's"),
        (ENCODER, reshape("controlnet.bias", (8,)), "a tensor 'controlnet.bias' of another model"),
        (ENCODER, reshape("conv_in.weight", (8, 9, 3, 3)), "'conv_in.weight' as \\(8, 9, 3, 3\\), but the base model"),
        (LORA, reshape("lora_unet_conv_in.alpha", ()), "lacks one half of the layer 'conv_in'"),
        (LORA, reshape("lora_te_text_model.lora_up.weight", (1, 1)), "which the base model lacks"),
        (LORA, reshape("conv_in.weight", (1,)), "which is no part of a LoRA"),
    ],
)
def test_wrong_tensors_are_named(mine, unet, file, change, words):
    spoil(mine / file, change)
    with pytest.raises(InputError, match=words):
        read_one(mine, file, unet)


@pytest.mark.parametrize("file", [POINTS, ATTENTION, ADAPTER, ENCODER, LORA, UNET])
def test_damaged_files_are_named(mine, file):
    (mine / file).write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(InputError, match=str((mine / file).parent)):
        load_all(mine)


WEIGHTS = (
    UNET,
    "vae/diffusion_pytorch_model.safetensors",
    "base/text_encoder/model.safetensors",
    "ip_adapter/models/image_encoder/model.safetensors",
    ENCODER,
    POINTS,
    ATTENTION,
    ADAPTER,
    LORA,
)


@pytest.mark.parametrize("file", WEIGHTS)
@pytest.mark.parametrize("part", [0.0, 0.7])
def test_files_that_end_too_early_are_named_with_what_to_do(mine, unet, file, part):
    path = mine / file
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(InputError, match=f"{path.parent}.*get (the file|its files) again"):
        read_one(mine, file, unet)


@pytest.mark.parametrize(
    ("file", "other"), [(POINTS, ATTENTION), (ATTENTION, POINTS), (ADAPTER, POINTS), (ENCODER, UNET), (LORA, UNET)]
)
def test_the_weights_of_something_else_are_named_with_what_to_do(mine, unet, file, other):
    shutil.copyfile(mine / other, mine / file)
    with pytest.raises(InputError, match=f"{mine / file}.*(get the right file|choose )"):
        read_one(mine, file, unet)


def test_a_pickle_with_code_in_it_is_not_run(tmp_path):
    class Evil:
        def __reduce__(self):
            return (tmp_path.joinpath("run").touch, ())

    path = tmp_path / "point_embedding.pt"
    torch.save({"conv_in.weight": Evil()}, path)
    with pytest.raises(InputError, match="cannot be read as plain weights"):
        load_point_embedding(path)
    assert not (tmp_path / "run").exists()


def quantised(state):
    state.update({key: (100 * value).to(torch.int8) for key, value in state.items()})


def spoilt_number(state):
    key = next(iter(state))
    state[key] = torch.full_like(state[key], float("nan"))


@pytest.mark.parametrize("file", [POINTS, ATTENTION, ENCODER, LORA])
@pytest.mark.parametrize(("change", "words"), [(quantised, "as int8"), (spoilt_number, "not finite")])
def test_numbers_that_are_no_weights_are_refused(mine, unet, file, change, words):
    """Loading would take both without a word: the one 100 times too large, the other as pictures of nothing."""
    spoil(mine / file, change)
    with pytest.raises(InputError, match=f"{mine / file}.*{words}"):
        read_one(mine, file, unet)


@pytest.mark.parametrize("file", WEIGHTS[:4])
def test_whole_models_are_of_finite_numbers(mine, file):
    spoil(mine / file, spoilt_number)
    with pytest.raises(InputError, match=f"{(mine / file).parent}.*not finite"):
        load_all(mine, scheduler="ddim")


@pytest.mark.parametrize("change", [lambda d: d.update(image_proj=[1]), lambda d: d.update({3: d["ip_adapter"]})])
def test_an_ip_adapter_of_other_tables_is_refused(mine, unet, change):
    spoil(mine / ADAPTER, change)
    with pytest.raises(InputError, match="does not belong there; choose ip-adapter_sd15"):
        read_one(mine, ADAPTER, unet)


PROJECTION = "lora_unet_mid_block_attentions_0_proj_in"


@pytest.mark.parametrize(
    "changed",
    [
        {f"{PROJECTION}.lora_down.weight": torch.zeros(3, 32, 1, 1)},
        {
            f"{PROJECTION}.lora_down.weight": torch.zeros(0, 32, 1, 1),
            f"{PROJECTION}.lora_up.weight": torch.zeros(32, 0, 1, 1),
        },
        {f"{PROJECTION}.alpha": torch.ones(2)},
    ],
)
def test_halves_of_a_lora_that_do_not_fit_are_named(mine, unet, changed):
    spoil(mine / LORA, lambda state: state.update(changed))
    with pytest.raises(InputError, match=r"two halves of the layer 'mid_block\.attentions\.0\.proj_in'"):
        read_one(mine, LORA, unet)


@pytest.mark.parametrize(
    ("config", "changed", "words"),
    [
        ("vae/config.json", {"scaling_factor": 0.13025}, "scaling_factor 0.13025, not 0.18215"),
        ("vae/config.json", {"shift_factor": 0.1}, "shift_factor 0.1"),
        ("vae/config.json", {"layers_per_block": 0}, "config.json of the VAE .* has no place for 'decoder"),
        ("vae/config.json", {"use_quant_conv": False}, "no place for 'quant_conv"),
        ("base/text_encoder/config.json", {"num_hidden_layers": 0}, "text encoder .* no place for '.*layers.0"),
        ("ip_adapter/models/image_encoder/config.json", {"num_hidden_layers": 0}, "image encoder .* no place for"),
        ("base/scheduler/scheduler_config.json", {"num_train_timesteps": 500}, "no schedule of noise that works"),
        ("base/scheduler/scheduler_config.json", {"num_train_timesteps": "1000"}, "no schedule of noise that works"),
        ("base/scheduler/scheduler_config.json", {"beta_schedule": "steep"}, "no schedule of noise that works .*steep"),
        ("base/scheduler/scheduler_config.json", {"beta_end": float("nan")}, "no schedule of noise that works"),
        ("base/scheduler/scheduler_config.json", {"steps_offset": 50}, "no schedule of noise that works"),
    ],
)
def test_configurations_of_another_model_are_refused(mine, config, changed, words):
    """What the libraries would take silently, and paint something else with."""
    edit_config(mine / config, **changed)
    with pytest.raises(InputError, match=words):
        load_all(mine, scheduler="ddim")


def test_a_tokenizer_of_fewer_words_than_its_text_encoder_is_refused(mine):
    """Its start and end of a text would have other numbers."""
    (mine / "base/tokenizer/vocab.json").write_text("{}")
    with pytest.raises(InputError, match=r"tokenizer in .* knows 2 words, the text encoder 8"):
        load_all(mine, scheduler="ddim")


def test_a_schedule_is_not_made_up(mine):
    (mine / "base/scheduler/scheduler_config.json").write_text("{}")
    with pytest.raises(InputError, match="does not say its beta_start"):
        load_all(mine, scheduler="ddim")


@pytest.mark.parametrize("number", ["-5", "null", '"7"', "3.5", "true", "1e400"])
def test_how_many_points_a_checkpoint_takes_is_a_number(mine, number):
    (mine / "lightning_drag/fine_tuned.json").write_text(f'{{"max_points": {number}}}')
    with pytest.raises(InputError, match=r"fine_tuned\.json' says max_points"):
        find_files(LightningDragOptions(models=str(mine))).fine_tuned()


def test_the_appearance_encoders_config_may_hold_anything(mine):
    """The original builds it from the base model's configuration."""
    config = mine / "lightning_drag/appearance_encoder/config.json"
    edit_config(config, block_out_channels=[8, 16, 16, 16], in_channels=9, cross_attention_dim=3)
    weights = load_file(mine / ENCODER)
    for change in (None, lambda: config.write_text("not even JSON"), config.unlink):
        if change is not None:
            change()
        state = load_appearance(config.parent, tiny_unet(9).config, torch.float32).state_dict()
        assert state.keys() == weights.keys()
        assert all(torch.equal(state[key], weights[key]) for key in weights)
    load_all(mine, scheduler="ddim")


def test_a_checkpoint_without_that_config_is_trained_and_taken(mine, tmp_path):
    (mine / "lightning_drag/appearance_encoder/config.json").unlink()
    model = load_all(mine, scheduler="ddim")
    write_checkpoint(model, tmp_path / "tuned", mine / "lightning_drag", {"max_points": 0})
    again = load_all(mine, scheduler="ddim", lightning_drag=str(tmp_path / "tuned"))
    for ours, theirs in ((model.appearance, again.appearance), (model.processors, again.processors)):
        for key, tensor in ours.state_dict().items():
            assert torch.equal(theirs.state_dict()[key], tensor), key


def test_models_that_do_not_belong_together_are_refused(mine):
    """An encoder of other widths is told by its tensors."""
    with pytest.raises(InputError, match=r"'conv_in.bias' as \(8,.* but the base model needs .*belong together"):
        load_appearance((mine / ENCODER).parent, tiny_unet(9, widths=(16, 16, 32, 32)).config, torch.float32)


def without_adapter(state):
    for key in [key for key in state if "_ip." in key]:
        del state[key]


def test_attention_weights_without_the_adapters_are_whole_once_merged(mine):
    """The published file has the size of the 48 tensors of the self-attentions; the other 32 are the IP-Adapter's."""
    spoil(mine / ATTENTION, without_adapter)
    own = torch.load(mine / ATTENTION, weights_only=True)
    adapter = torch.load(mine / ADAPTER, weights_only=True)["ip_adapter"]
    assert (len(own), len(adapter)) == (48, 32)
    state = load_all(mine, scheduler="ddim").processors.state_dict()
    assert len(state) == 80
    assert all(torch.equal(state[key], tensor) for key, tensor in {**own, **adapter}.items())


@pytest.mark.parametrize("whole", [True, False])
def test_a_lack_is_blamed_on_the_file_that_should_have_it(mine, unet, whole):
    """Whichever of the two the attention file holds."""
    if not whole:
        spoil(mine / ATTENTION, without_adapter)
    spoil(mine / ADAPTER, lambda s: s["ip_adapter"].pop("1.to_k_ip.weight"))
    with pytest.raises(InputError, match=r"The IP-Adapter .* lacks the tensor '1\.to_k_ip\.weight'"):
        read_one(mine, ATTENTION, unet)
    shutil.copyfile(mine / ATTENTION, mine / ADAPTER)
    with pytest.raises(InputError, match=r"The IP-Adapter .* does not belong there; choose ip-adapter_sd15"):
        read_one(mine, ATTENTION, unet)


TEXT, IMAGE = "base/text_encoder", "ip_adapter/models/image_encoder"


@pytest.mark.parametrize("pickled", [False, True])
def test_clip_files_of_the_old_layout_load(mine, models, pickled):
    """As published: every name under `text_model.` or `vision_model.`, and the positions' numbers among the weights."""
    wanted = load_all(models, scheduler="ddim")
    for folder, stem, length in ((TEXT, "text_model", 77), (IMAGE, "vision_model", 5)):
        path = mine / folder / "model.safetensors"
        heads = (f"{stem}.", "visual_projection.")
        state = {key if key.startswith(heads) else f"{stem}.{key}": v for key, v in load_file(path).items()}
        state[f"{stem}.embeddings.position_ids"] = torch.arange(length)[None]
        path.unlink()
        if pickled:
            torch.save(state, path.with_name("pytorch_model.bin"))
        else:
            save_file(state, path, metadata={"format": "pt"})
    model = load_all(mine, scheduler="ddim")
    assert torch.equal(model.text, wanted.text)
    for key, tensor in wanted.image_encoder.state_dict().items():
        assert torch.equal(model.image_encoder.state_dict()[key], tensor), key


def test_a_vae_of_the_old_layout_loads(mine, models):
    """`sd-vae-ft-mse` calls its attention's parts query, key, value and proj_attn."""
    path = mine / "vae/diffusion_pytorch_model.safetensors"
    new = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    state = {}
    for key, tensor in load_file(path).items():
        for name, old in new.items():
            key = key.replace(f"attentions.0.{name}.", f"attentions.0.{old}.")
        state[key] = tensor
    assert any(".proj_attn." in key for key in state)
    save_file(state, path, metadata={"format": "pt"})
    ours, theirs = (load_all(folder, scheduler="ddim").vae.state_dict() for folder in (mine, models))
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_everything_but_the_prompt_is_loaded_in_half_precision(mine, dtype):
    model = load(find_files(LightningDragOptions(models=str(mine))), dtype)
    for module in (*model.encoders, *model.denoisers):
        assert {p.dtype for p in module.parameters()} == {dtype}
    tuned = load(find_files(LightningDragOptions(models=str(mine))), dtype, trained=torch.float32)
    assert {p.dtype for p in tuned.point_embedding.parameters()} == {torch.float32}
    assert {p.dtype for p in tuned.appearance.parameters()} == {torch.float32}
    assert {p.dtype for p in tuned.vae.parameters()} == {dtype}


def test_half_precision_files_are_taken_where_there_are_no_others(mine):
    unet = mine / "base/unet"
    (unet / "diffusion_pytorch_model.safetensors").rename(unet / "diffusion_pytorch_model.fp16.safetensors")
    assert load_all(mine, scheduler="ddim").unet.config.in_channels == 9
