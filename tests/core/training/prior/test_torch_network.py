# SPDX-License-Identifier: GPL-3.0-or-later
"""The network that is trained: shapes, missing tokens, the exchange among splats against plain loops; and the one in
numpy that answers in its place."""

from __future__ import annotations

import numpy as np
import torch

from gskin_addon.core.rig.bone_roles import ROLES
from gskin_addon.core.skinning.learned import network as in_numpy
from gskin_addon.core.skinning.learned.features import NAMES, TOKENS, Description
from gskin_addon.core.skinning.learned.network import Shape, parameter_shapes
from gskin_addon.core.skinning.learned.parts import Parts
from gskin_addon.core.skinning.learned.tree import kinship
from gskin_addon.core.training.prior.torch_network import PriorNetwork, make_batch, pool_tokens


def fake_body(count, bones, rng):
    tokens = min(TOKENS, bones)
    bone = np.full((count, TOKENS), -1)
    for n in range(count):
        bone[n, :tokens] = rng.permutation(bones)[:tokens]
    return {
        "bone": bone,
        "values": rng.normal(size=(count, TOKENS, len(NAMES))).astype(np.float32),
        "relation": kinship(np.array([-1, *(rng.integers(0, b) for b in range(1, bones))])),
        "role": rng.integers(0, len(ROLES), bones),
        "near": rng.integers(0, count, (count, 5)),
        "wide": rng.integers(0, count, (count, 12)),
        "labels": rng.integers(0, 3, (count, 3)),
    }


def random_network(seed=0):
    torch.manual_seed(seed)
    network = PriorNetwork(Shape(width=32, heads=2))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return network.eval()


def test_shapes_and_missing_bones():
    rng = np.random.default_rng(0)
    network = random_network()
    with torch.no_grad():
        answer = network(make_batch([fake_body(30, 4, rng), fake_body(20, 40, rng), fake_body(9, 1, rng)]))
    share = answer.final.softmax(-1)
    assert share.shape == (59, TOKENS)
    assert answer.doubt.shape == (59,)
    assert share[:30, 4:].max() == 0
    torch.testing.assert_close(share[50:, 0], torch.ones(9))
    assert torch.isfinite(answer.final).all()


def test_bodies_in_a_batch_do_not_meet():
    rng = np.random.default_rng(1)
    network = random_network()
    bodies = [fake_body(30, 14, rng), fake_body(20, 20, rng)]
    with torch.no_grad():
        both = network(make_batch(bodies)).final
        alone = [network(make_batch([body])).final for body in bodies]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-4, rtol=1e-4)


def test_the_order_of_tokens_is_of_no_importance():
    rng = np.random.default_rng(2)
    network, body = random_network(), fake_body(25, 20, rng)
    order = np.stack([rng.permutation(TOKENS) for _ in range(25)])
    mixed = {
        **body,
        "bone": np.take_along_axis(body["bone"], order, 1),
        "values": np.take_along_axis(body["values"], order[:, :, None], 1),
    }
    with torch.no_grad():
        a, b = network(make_batch([body])).final, network(make_batch([mixed])).final
    torch.testing.assert_close(b, a.gather(1, torch.from_numpy(order)), atol=1e-4, rtol=1e-4)


def test_pooling_matches_plain_loops():
    rng = np.random.default_rng(3)
    body = fake_body(12, 5, rng)
    words = torch.from_numpy(rng.normal(size=(12, TOKENS, 2))).float()
    bone = torch.from_numpy(body["bone"])
    near = [torch.from_numpy(body[key]) for key in ("near", "wide")]
    got = pool_tokens(words, bone, 5, near, torch.from_numpy(body["labels"])).numpy()

    def say(m, b):
        at = np.flatnonzero(body["bone"][m] == b)
        return words[m, at[0]].numpy() if len(at) else np.zeros(2)

    for n in range(12):
        for k in range(5):
            b = body["bone"][n, k]
            groups = [body["near"][n], body["wide"][n]]
            groups += [np.flatnonzero(column == column[n]) for column in body["labels"].T]
            expected = [np.mean([say(m, b) for m in group], axis=0) for group in groups]
            np.testing.assert_allclose(got[n, k], expected, atol=1e-5)


def test_an_untrained_network_gives_the_heat_weights():
    rng = np.random.default_rng(4)
    body = fake_body(10, 20, rng)
    heat = rng.dirichlet(np.ones(TOKENS), 10)
    body["values"][:, :, NAMES.index("heat")] = np.log(heat)
    with torch.no_grad():
        answer = PriorNetwork()(make_batch([body]))
    np.testing.assert_allclose(answer.final.softmax(-1), heat, atol=1e-5)


def as_numpy(network):
    parameters = {name: value.numpy() for name, value in network.state_dict().items()}
    return in_numpy.PriorNetwork(network.shape, parameters)


def described(body):
    description = Description(body["bone"].astype(np.int16), body["values"], body["relation"], body["role"])
    return description, Parts((body["near"], body["wide"]), body["labels"].astype(np.int32))


def test_both_networks_have_the_same_parameters():
    for shape in (Shape(), Shape(width=32, heads=2, before=1, after=2, channels=3, style=5)):
        have = {name: tuple(value.shape) for name, value in PriorNetwork(shape).state_dict().items()}
        assert parameter_shapes(shape) == have


def test_numpy_answers_as_torch_does():
    """With few bones, with many, with one, and with more splats than a block has."""
    rng = np.random.default_rng(5)
    network = random_network()
    network.mean.copy_(torch.randn(len(NAMES)))
    network.deviation.copy_(torch.rand(len(NAMES)) + 0.5)
    for count, bones in ((30, 4), (950, 40), (9, 1), (2, 12)):
        body = fake_body(count, bones, rng)
        with torch.no_grad():
            expected = network(make_batch([body]))
        got = as_numpy(network)(*described(body))
        for name in ("first", "final", "doubt"):
            wanted = getattr(expected, name).numpy()
            np.testing.assert_allclose(getattr(got, name), wanted, rtol=2e-3, atol=2e-3, err_msg=name)
        share = expected.final.softmax(-1).numpy()
        np.testing.assert_allclose(in_numpy.softmax(got.final), share, atol=1e-4)
