# SPDX-License-Identifier: Apache-2.0
"""RefinedSweepNet: what it starts from, what it chooses between, and that it learns."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.data import ToSphere
from sphericalvision.data.augmentation.fivefold import rotate_fivefold
from sphericalvision.icosphere import Icosphere, icosphere_neighbors
from sphericalvision.icosphere.hierarchy import icosphere_vertex_parents
from sphericalvision.kernels import kernels
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import IcoSweepNet, RefinedSweepNet, pretrained
from sphericalvision.models.candidate_refinement import (
    RARE,
    CandidateRefinement,
    Candidates,
    candidates_of,
    finer_logits,
)
from sphericalvision.models.hexunet import HexUNet
from sphericalvision.models.hint_gate import HintedIndex, HintGate, agreement
from sphericalvision.models.logit_fusion import FusedLogits
from sphericalvision.models.refinedsweepnet import (
    ENTROPY_SHARE,
    EXPECTED_ERROR_SHARE,
    FARTHEST,
    RARE_SKY,
    _loss_of_modes,
)
from sphericalvision.models.tried_hypotheses import two_modes
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sweep import DepthHint, index_from_depth, inverse_depth_from_index
from sphericalvision.sweep.appearance_at_depth import (
    AppearanceAtDepth,
    appearance_around,
    appearance_at_depth,
)
from sphericalvision.sweep.ring_mean import ids_of_coarser_level
from tests.laws.grid_laws import UP, rotation_about

PRIOR = {
    "feature_channels": 4,
    "norm": "instance",
    "aggregation": "variance",
    "feature_coarsening": 1,
    "volume_channels": 2,
}
LEVEL = 4


@pytest.fixture(scope="module")
def frame():
    """Images, rig, what is seen, and the true index of a room."""
    rig = ring_rig(4, image_size=(96, 96))
    scene = make_scene("room", seed=5)
    to_sphere = ToSphere(LEVEL)
    images, seen = to_sphere.images(render_rig(scene, rig, 2), rig)[None], to_sphere.seen(rig)[None]
    depth = ray_depth(scene, rig.center, Icosphere(LEVEL).vertices)
    return images, rig, seen, index_from_depth(depth, 16, 0.55)[None]


@pytest.fixture
def net():
    torch.manual_seed(0)
    prior = IcoSweepNet(LEVEL, 16, num_cameras=2, **PRIOR)
    return RefinedSweepNet.around(prior, level=LEVEL, widths=(8, 8, 8), blocks=(1, 1, 2)).eval()


def test_starts_from_the_sum_of_costs_and_prior(net, frame):
    images, rig, seen, true = frame
    with torch.inference_mode():
        tables = net.tables(rig)
        clues = net.clues(images, tables, seen)
        logits = net.fuse(clues, images, seen, tables.offsets).logits
        index = net.predict(images, tables, seen).index
    assert (clues.cost.amin(1) == 0).all()
    # An untrained prior is nearly flat, so the least cost is the likeliest hypothesis nearly everywhere.
    assert (logits.argmax(1) == clues.cost.argmin(1)).float().mean() > 0.9
    valid = true <= 15
    assert (index - true)[valid].abs().mean() < 0.5 * (true.median() - true)[valid].abs().mean()


def test_turns_by_72_degrees_turn_the_answer(net, frame):
    """At every vertex, but for those whose two parents change order: one candidate is taken from the first of them."""
    images, rig, seen, _ = frame
    turn = rotation_about(-UP, 2 * math.pi / 5).float()
    with torch.inference_mode():
        expected = net.predict(images, rig, seen)
        turned = net.predict(rotate_fivefold(images, 1), rig.rotated(rotation=turn), rotate_fivefold(seen, 1))
    first = icosphere_vertex_parents(LEVEL, torch.device("cpu"))[:, 0]
    came_from = [
        rotate_fivefold(torch.arange(Icosphere(level).num_vertices), 1) for level in (LEVEL - 1, LEVEL)
    ]
    ordered = came_from[0][first] == first[came_from[1]]
    assert ordered.float().mean() > 0.95
    assert torch.equal(turned.seen, rotate_fivefold(expected.seen, 1))
    assert (turned.confidence - rotate_fivefold(expected.confidence, 1)).abs().max() < 1e-4
    difference = (turned.index - rotate_fivefold(expected.index, 1)).abs()
    assert difference[:, ordered].max() < 1e-3
    assert difference.max() < 0.5


def test_more_levels_are_more_steps_with_the_same_weights(net, frame):
    """Images that were averaged give the coarser network's sweep; what a step answers is what the next begins with."""
    images, rig, seen, _ = frame
    coarse = net.with_changes(level=LEVEL - 1, widths=None, coarse_level=2)
    fine = net.with_changes(coarse_level=2)
    with torch.inference_mode():
        views = fine.views(images, seen)
        assert [view.shape[-1] for view, _ in views] == [642, 2562]
        expected = coarse.predict(*views[0][:1], rig, views[0][1])
        answer = fine.predict(images, rig, seen)
    parents = icosphere_vertex_parents(LEVEL, torch.device("cpu"))
    # An untrained step answers with the mean of both parents.
    between = expected.index[:, parents].mean(-1)
    assert (answer.index - between).abs().median() < 0.3
    assert answer.seen.shape == (1, 2562)


def test_more_cameras_than_rigs_of_the_training_had_count_as_these(net, frame, monkeypatch):
    """Layers meet no number that they have not learned from: six, twenty and sixty are one to them."""
    images, rig, seen, _ = frame
    tables = net.tables(rig)
    with torch.inference_mode():
        clues, views = net.clues(images, tables, seen), net.views(images, seen)
        appearance = net._appearance
        answers = []
        for count in (6, 20, 60, 2):
            monkeypatch.setattr(
                net,
                "_appearance",
                lambda *x, n=count: appearance(*x)._replace(cameras=n * torch.ones_like(x[0])),
            )
            many = clues._replace(cameras=count * torch.ones_like(clues.cameras))
            fused = net.fuse(many, images, seen, tables.offsets)
            answers.append((fused.logits, fused.state, *net.refinements(fused, views, tables.offsets)[-1]))
    six, *more, two = answers
    for answer in more:
        assert all(map(torch.equal, answer, six))
    assert not torch.equal(two[1], six[1])


def test_shipped_weights_repeat_their_step_at_finer_levels():
    """And sweep no finer: their coarse stages stay at level 5, or below the images where these are coarser."""
    coarse = [pretrained("refinedsweepnet").with_changes(level=level).coarse_level for level in (5, 6, 7, 8)]
    assert coarse == [4, 5, 5, 5]


def test_learns_in_all_steps(net, frame):
    images, rig, seen, true = frame
    finer = net.with_changes(coarse_level=2)
    valid = true <= 15
    finer.training_loss(images, rig, seen, true.clamp(max=15), valid, depth_index_huber).backward()
    assert finer.refinement.exit.bias.grad.abs().sum() > 0
    with pytest.raises(ArgumentError, match=r"coarse_level: expected 2 or more for 3 widths, got 1"):
        net.with_changes(coarse_level=1)


def test_learns_and_leaves_the_prior_alone(net, frame):
    images, rig, seen, true = frame
    valid = true <= 15
    before = {name: value.clone() for name, value in net.prior.state_dict().items()}
    optimizer = torch.optim.Adam([p for p in net.parameters() if p.requires_grad], 3e-3)
    losses = []
    for _ in range(40):
        loss = net.training_loss(images, rig, seen, true, valid, depth_index_huber)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]
    assert all(torch.equal(value, before[name]) for name, value in net.prior.state_dict().items())


def test_without_a_learning_refinement_or_hint_gate_the_refinement_has_no_part_in_the_loss(net, frame):
    images, rig, seen, true = frame
    fusing = RefinedSweepNet.around(net.prior, level=LEVEL, widths=(8, 8, 8), blocks=(1, 1, 2))
    fusing.refinement.requires_grad_(False)
    fusing.fusion.hint_gate.requires_grad_(False)
    first = fusing.training_loss(images, rig, seen, true, true <= 15, depth_index_huber)
    first.backward()
    assert all(p.grad is not None for p in fusing.parameters() if p.requires_grad)
    for weight in fusing.refinement.parameters():
        weight.data.fill_(math.nan)
    assert torch.equal(first, fusing.training_loss(images, rig, seen, true, true <= 15, depth_index_huber))


def test_what_is_not_known_teaches_nothing(net, frame):
    """Neither surfaces nor sky, which is where the index is 0."""
    images, rig, seen, true = frame
    right, down, _ = Icosphere(LEVEL).vertices.T
    valid, true = right > 0, true.masked_fill(down < -0.95, 0.0)  # a little sky
    losses = [
        net.training_loss(images, rig, seen, true.where(valid, other), valid[None], depth_index_huber)
        for other in (0.0, 9.0)
    ]
    assert torch.equal(*losses)


def test_prior_learns_where_it_is_told_to(net):
    learning = RefinedSweepNet.around(net.prior, train_prior=True, level=LEVEL, widths=(8, 8), blocks=1)
    assert all(weight.requires_grad for weight in learning.prior.parameters())


@pytest.mark.parametrize("index", [2, 5, 9])
def test_prior_is_drawn_to_the_true_index(net, frame, index):
    images, rig, seen, true = frame
    with torch.no_grad():
        clues = net.clues(images, net.tables(rig), seen)
        net.fusion.sharpness[1] = -30  # it has no part in the fused logits
    prior = torch.zeros_like(clues.prior).requires_grad_()
    target, valid = torch.full_like(true, index), torch.ones_like(true, dtype=torch.bool)
    clues = clues._replace(prior=prior)
    net.training_loss(images, rig, seen, target, valid, depth_index_huber, clues=clues).backward()
    assert (prior.grad.argmin(1) == index).all()


def test_other_modes_are_drawn_to_the_true_index_the_more_the_nearer_they_are(net, frame):
    """The index around the best mode, at 2, tells nothing of them; cross entropy alone draws to the true index only."""
    images, rig, seen, true = frame
    with torch.no_grad():
        clues = net.clues(images, net.tables(rig), seen)
    prior = torch.zeros_like(clues.prior)
    prior[:, 2] = 6.0
    clues = clues._replace(prior=prior.requires_grad_(), cost=torch.zeros_like(clues.cost))
    target, valid = torch.full_like(true, 12), torch.ones_like(true, dtype=torch.bool)
    net.training_loss(images, rig, seen, target, valid, depth_index_huber, clues=clues).backward()
    drawn = -prior.grad.mean((0, 2))
    assert drawn[12] > drawn[11] > drawn[10] > drawn[9] > drawn[8] > drawn[2]


def test_modes_learn_cross_entropy_and_the_mean_distance_by_probability():
    logits = (
        torch.tensor([0.1, 0.2, 0.4, 0.2, 0.1]).log().view(1, 5, 1)
    )  # of the indices 0, 1/2, 1, 3/2 and 2
    entropy = -(math.log(0.2) + math.log(0.4)) / 2
    distance = 0.1 * 0.75 + 0.2 * 0.25 + 0.4 * 0.25 + 0.2 * 0.75 + 0.1 * 1.25
    loss = _loss_of_modes(logits, torch.tensor([[0.75]])).item()
    assert loss == pytest.approx(ENTROPY_SHARE * entropy + EXPECTED_ERROR_SHARE * distance)


def sky_logit_gradient(net, frame, true, logit=RARE):
    """How the loss changes with the logit of the sky, where that is the same at all vertices."""
    images, rig, seen, _ = frame
    bias = net.refinement.exit.bias
    bias.data[6], bias.grad = logit, None
    bias.requires_grad_(True)
    net.training_loss(
        images, rig, seen, true, torch.ones_like(true, dtype=torch.bool), depth_index_huber
    ).backward()
    return bias.grad[6].item()


def test_sky_is_infinitely_far_and_no_surface_is(net, frame):
    images, rig, seen, _ = frame
    bias = net.refinement.exit.bias
    with torch.inference_mode():
        bias[6] = 4.0
        assert (net.predict(images, rig, seen).index == 0).all()
        bias[:] = torch.tensor([9.0, 0, 0, 0, -99, 0, RARE])
        surface = net.predict(images, rig, seen).index  # 99 hypotheses less, but not sky
    torch.testing.assert_close(surface, torch.full_like(surface, FARTHEST))


@pytest.mark.parametrize(("share", "weight"), [(0.5, 1.0), (0.05, 1.0), (0.025, 2.0), (0.01, 4.0)])
def test_little_sky_counts_more_and_its_logit_says_how_likely_sky_is(net, frame, share, weight):
    """Sky counts ``weight`` times in the cross entropy of a logit that is higher by the logarithm of that."""
    no_sky = torch.ones_like(frame[3])
    true = no_sky.clone()
    number = round(share * true.shape[-1])
    true[:, :number] = 0.0
    share = number / true.shape[-1]
    assert min(max(RARE_SKY / share, 1.0), 4.0) == pytest.approx(
        weight, rel=0.05
    )  # shares are of whole vertices
    weight = min(max(RARE_SKY / share, 1.0), 4.0)

    def called(weight):
        return 1 / (1 + math.exp(-RARE - math.log(weight)))

    scale = sky_logit_gradient(net, frame, no_sky) / called(4)
    expected = (1 - share) * called(weight) - share * weight * (1 - called(weight))
    assert sky_logit_gradient(net, frame, true) == pytest.approx(scale * expected, rel=1e-3)
    settled = sky_logit_gradient(net, frame, true, math.log(share / (1 - share)))
    assert abs(settled) < 1e-4 * scale


def test_modes_are_means_within_two_hypotheses_of_the_best_ones(generator):
    """Of 2 N - 1 tried hypotheses: of the best one, and of the best that is farther away than that."""
    logits = 3 * torch.randn(1, 31, 50, generator=generator)
    index = torch.arange(31) / 2
    for column, *modes in zip(logits[0].T, *(mode[0] for mode in two_modes(logits)), strict=True):
        best = index[column.argmax()]
        second = index[column.where((index - best).abs() > 2, -torch.inf).argmax()]
        for mode, center in zip(modes, (best, second), strict=True):
            close = (index - center).abs() <= 2
            torch.testing.assert_close(mode, (column[close].softmax(0) * index[close]).sum())


@pytest.mark.parametrize("hinted", [False, True])
def test_candidates_by_loops(hinted, generator):
    """Of both parents; a hint takes the place of the second answer where it is as likely."""
    grid, parents = Icosphere(1), icosphere_vertex_parents(2).tolist()
    logits = 2 * torch.randn(2, 15, 42, generator=generator)
    best, second = two_modes(logits)
    hint = HintedIndex(7 * torch.rand(2, 162, generator=generator), torch.arange(324).view(2, 162) % 3 / 2)
    found = candidates_of(FusedLogits(logits, torch.zeros(2, 1, 42)), hint=hint if hinted else None)
    probability, tried = logits.softmax(1), torch.arange(15) / 2
    rings = [[vertex, *(n for n in ring if n >= 0)] for vertex, ring in enumerate(grid.neighbors.tolist())]
    took = 0
    for sample, vertex in itertools.product(range(2), range(0, 162, 8)):
        pair, index = parents[vertex], best[sample]
        around = index[[n for parent in pair for n in rings[parent]]]
        four = [
            index[pair].mean(),
            around.max(),
            around.min(),
            second[sample, pair[0]],
            hint.index[sample, vertex],
        ]
        likely = [probability[sample, round(2 * float(i)), pair].mean() for i in four]
        take = hinted and hint.weight[sample, vertex] > 0 and likely[4] >= likely[3]
        took += int(take)
        chosen = [0, 1, 2, 4 if take else 3]
        spread = [(probability[sample, :, n] * (tried - index[n]).abs()).sum() for n in pair]
        expected = (
            torch.stack([four[k] for k in chosen]),
            torch.stack([likely[k] for k in chosen]),
            (index[pair[0]] - index[pair[1]]).abs(),
            torch.stack(spread).mean(),
        )
        torch.testing.assert_close((*(each[sample, ..., vertex] for each in found),), expected)
    assert bool(took) == hinted


@pytest.mark.parametrize(("weight", "second"), [(0.1, 9.0), (0.01, 3.0)])
def test_what_is_not_chosen_remains_if_it_is_plausible(weight, second):
    """Else the second answer of the level before does, the last of the candidates."""
    refinement, shape = CandidateRefinement(2), (1, 4, 42)
    with torch.no_grad():
        refinement.exit.bias[:4] = torch.tensor([1 - weight, weight, 1e-9, 1e-9]).log()
    index = torch.tensor([1.0, 9.0, 1.0, 3.0])[None, :, None].expand(shape)
    candidates = Candidates(index, torch.ones(shape), torch.zeros(1, 42), torch.zeros(1, 42))
    appearance = AppearanceAtDepth(torch.ones(1, 4, 3, 42), torch.ones(shape), torch.full(shape, 2))
    result = refinement(candidates, appearance, torch.zeros(1, 2, 12), 31)
    torch.testing.assert_close(result.index, torch.full((1, 42), 1 + 8 * weight))
    torch.testing.assert_close(result.second, torch.full((1, 42), second))


def test_gates_change_weights_by_three_powers_of_e_at_most(net):
    most, least = (net.fusion._weights(torch.full((1, 2, 5), gate)) for gate in (50.0, -50.0))
    for high, low, sharpness in zip(most, least, net.fusion.sharpness, strict=True):
        torch.testing.assert_close(high, (sharpness + 3).exp().expand_as(high))
        torch.testing.assert_close(low, (sharpness - 3).exp().expand_as(low))


def test_depths_do_not_depend_on_the_hypotheses_that_they_are_counted_in(net, frame):
    """Inside they are counted in others, to and fro."""
    images, rig, seen, true = frame
    finer = net.with_changes(num_hypotheses=31)
    finer.prior.requires_grad_(False)
    with torch.no_grad():
        ours, theirs = (one.predict(images, rig, seen).index for one in (net, finer))
        torch.testing.assert_close(theirs, 2 * ours)
        losses = [
            one.training_loss(images, rig, seen, target, true <= 15, depth_index_huber)
            for one, target in ((net, true), (finer, 2 * true))
        ]
    torch.testing.assert_close(*losses)


def test_what_nobody_sees_has_no_confidence_and_some_depth(net, frame):
    images, rig, seen, _ = frame
    with torch.inference_mode():
        index, confidence, both = net.predict(images, rig, torch.zeros_like(seen))
        # What cameras see beyond infinity is what they see there.
        offsets = (rig.center - rig.positions)[None]
        beyond, there = (
            net._appearance(torch.full((1, 1, 642), at), images, seen, offsets) for at in (-9.0, 0.0)
        )
    assert not both.any()
    assert not confidence.any()
    assert index.isfinite().all()
    torch.testing.assert_close(beyond, there, rtol=0, atol=0)


def test_cameras_agree_at_the_true_depth(frame):
    images, rig, seen, true = frame
    inverse_depth = true / (15 * 0.55)
    offsets = (rig.center - rig.positions)[None]
    tried = torch.stack((inverse_depth, inverse_depth * 0.5, inverse_depth * 1.6), 1)
    color, deviation, cameras = appearance_at_depth(images, seen[0], offsets, tried)
    shared = (cameras >= 2).all(1)
    right, far, near = (deviation[:, k][shared].mean() for k in range(3))
    assert right < 0.7 * far
    assert right < 0.7 * near
    assert color.abs().max() <= 1 + 1e-5
    assert cameras.max() <= 4
    scattered = torch.rand(seen.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    color, _, cameras = appearance_at_depth(torch.full_like(images, 0.7), scattered, offsets, tried)
    known = (cameras > 0)[:, :, None].expand_as(color)  # by most of what is interpolated
    assert 0.1 < known.float().mean() < 1
    torch.testing.assert_close(color, 0.7 * known)


def test_around_the_chosen_vertices_cameras_agree_at_the_true_depth(frame):
    images, rig, seen, true = frame
    index = true[:, ids_of_coarser_level(LEVEL, LEVEL - 1)]
    inverse_depths = torch.stack((index, index * 0.5), 1) / (15 * 0.55)
    chosen, offsets = torch.arange(642)[None] % 3 == 0, (rig.center - rig.positions)[None]
    around = appearance_around(images, seen, offsets, inverse_depths, chosen)
    color, deviation, _ = appearance_at_depth(images, seen, offsets, inverse_depths)
    torch.testing.assert_close(around[:, :, 0], deviation * chosen)
    torch.testing.assert_close(around[:, :, 4:], color * chosen[:, None, None])
    assert (around[:, :, 1] <= around[:, :, 2]).all()
    right, far = around[0, :, 1:3][..., chosen[0]].mean(-1)
    assert (right < 0.8 * far).all()
    nowhere = torch.zeros_like(chosen)  # a view without any boundary
    assert not appearance_around(images, seen, offsets, inverse_depths, nowhere).any()
    with kernels("graph"):  # computed everywhere, and then left out
        torch.testing.assert_close(
            appearance_around(images, seen, offsets, inverse_depths, chosen), around, rtol=1e-3, atol=1e-4
        )


def test_details_change_nothing_before_training_and_learn_where_images_are_finer(net, frame):
    images, rig, seen, true = frame
    plain = net.with_changes(coarse_level=2)
    detailed = RefinedSweepNet(**{**plain.hyperparameters, "details": True}).eval()
    assert detailed.load_state_dict(plain.state_dict(), strict=False).missing_keys == [
        "refinement.details.weight"
    ]
    with torch.inference_mode():
        for one, other in zip(
            plain.predict(images, rig, seen), detailed.predict(images, rig, seen), strict=True
        ):
            assert torch.equal(one, other)
    torch.nn.init.normal_(detailed.refinement.exit.weight, 0, 0.1)
    coarser, ids = detailed.at_level(LEVEL - 1), ids_of_coarser_level(LEVEL, LEVEL - 1)
    assert (detailed.image_level, coarser.image_level, plain.image_level) == (LEVEL + 1, LEVEL, LEVEL)
    of_images = {LEVEL: (images, seen), LEVEL - 1: (images[..., ids], seen[..., ids])}
    for network, level, learns in (
        (detailed, LEVEL, True),
        (coarser, LEVEL, True),
        (coarser, LEVEL - 1, False),
    ):
        target = true if network is detailed else true[:, ids]
        views, visible = of_images[level]
        with torch.inference_mode():  # of tables of finer images, too
            estimate = network.predict(views, network.tables(rig))
        assert estimate.index.shape == target.shape
        detailed.zero_grad()
        network.training_loss(views, rig, visible, target, target > 0, depth_index_huber).backward()
        gradient = detailed.refinement.details.weight.grad  # of several processes each wants one
        assert gradient is not None
        assert bool(gradient.any()) == learns
    with pytest.raises(ShapeError, match="642 or 2562"):
        coarser.predict(images[..., :162], rig)


def test_a_unet_begins_as_an_identity_and_each_coarser_level_learns_at_once():
    values, net = torch.rand(2, 4, 162), HexUNet((4, 6, 8), blocks=2)
    assert torch.equal(net(values), values)
    net(values).square().sum().backward()
    assert net.refine[0].weight.grad.any()
    torch.nn.init.ones_(net.refine[0].weight)
    net(values).square().sum().backward()
    assert net.refine[1].weight.grad.any()


def test_values_keep_their_size_down_to_the_coarsest_level(generator):
    net, sizes = HexUNet((32, 48, 64, 96)), []
    for block in net.down:
        block.register_forward_hook(
            lambda module, values, result: sizes.append(result.square().mean().sqrt())
        )
    net(torch.randn(1, 32, 642, generator=generator))
    assert all(0.5 < size < 2 for size in sizes)


def test_a_finer_level_begins_near_the_chosen_index_and_forbids_nothing():
    """What is two hypotheses away or more costs the same."""
    finer = finer_logits(
        FusedLogits(torch.zeros(1, 31, 42), torch.zeros(1, 2, 42)), torch.full((1, 162), 4.0)
    )
    expected = -2 * (torch.arange(31) / 2 - 4).abs().clamp(max=2)
    torch.testing.assert_close(finer.logits[0] - finer.logits[0, 8], expected[:, None].expand(31, 162))


def test_a_hint_is_compared_where_two_cameras_look_and_near_things_roughly():
    answer, ones = torch.linspace(0, 15, 400)[None], torch.ones(1, 400)
    hint, compared = HintedIndex((answer + 1.4).clamp(max=15), ones), answer < 5
    assert agreement(hint, answer, 1.0 * (answer > 8), 31).item() == pytest.approx(1, abs=0.1)
    assert agreement(hint, answer, 1.0 * compared, 31).item() < 0.1
    around = (torch.arange(31)[:, None] / 2 - hint.index[:, None]).abs() < 1
    cost = torch.where(around, torch.where(compared, 0.2, 9.0)[:, None], 1.0)  # of any other depth 1
    for here, trust in ((compared, 1.0), (~compared, 0.0)):
        assert HintGate.trust(hint, cost, torch.zeros(1, 31, 400), here).item() == trust


def test_a_hint_that_is_not_trusted_changes_nothing(net, frame, monkeypatch):
    images, rig, seen, true = frame
    hint = DepthHint(torch.full_like(true, 0.3), torch.ones_like(true))
    monkeypatch.setattr(HintGate, "trust", lambda *_: torch.ones(1, 1))
    expected = net.predict(images, rig, seen)
    assert not torch.equal(net.predict(images, rig, seen, hint).index, expected.index)
    monkeypatch.setattr(HintGate, "trust", lambda *_: torch.zeros(1, 1))
    torch.testing.assert_close(net.predict(images, rig, seen, hint), expected, rtol=0, atol=0)


def test_the_penalty_of_a_hint_by_hand():
    """At 1.25 between two tried hypotheses; what is more than four hypotheses away is as far as any."""
    hint = HintedIndex(torch.tensor([[1.25]]), torch.tensor([[0.5]]))
    penalty = HintGate(3).penalty(hint, torch.rand(1, 3, 1), 21)[0, :, 0]
    torch.testing.assert_close(penalty, 1.5 * (torch.arange(21) / 2 - 1.25).abs().clamp(max=4))


def test_hints_of_numpy_are_those_in_single_precision(net, frame):
    images, rig, seen, true = frame
    nearest = net.hints(DepthHint(torch.full_like(true, 99.0), torch.ones_like(true)))
    assert all((level.index == 15).all() for level in nearest)  # nearer than any hypothesis
    hint = DepthHint(inverse_depth_from_index(true, 16, 0.55), torch.ones_like(true))
    found = net.predict(images, rig, seen, DepthHint(*(values.double() for values in hint)))
    torch.testing.assert_close(found, net.predict(images, rig, seen, hint), rtol=0, atol=0)


def test_rigs_in_double_precision_are_taken(net, frame):
    images, rig, seen, _ = frame
    found = net.predict(images, rig.to(torch.float64), seen)
    torch.testing.assert_close(found.index, net.predict(images, rig, seen).index, rtol=0, atol=1e-2)


def test_tables_of_another_level_are_refused(net, frame):
    images, rig, seen, _ = frame
    with pytest.raises(ShapeError, match="rig: expected tables for images of"):
        net.predict(images, net.with_changes(level=net.level + 1).tables(rig), seen)


def test_a_hint_helps_and_one_that_contradicts_the_images_hardly_harms():
    """With the weights that ship, in a room with bare walls; in directions of one camera alone it says the most."""
    net, rig = (
        pretrained().at_level(5).eval(),
        ring_rig(4, image_size=(160, 160), field_of_view=2.4),
    )
    scene, to_sphere = make_scene("plain", seed=4), ToSphere(5)
    images, seen = to_sphere.images(render_rig(scene, rig, 1), rig)[None], to_sphere.seen(rig)[None]
    inverse_depth = ray_depth(scene, rig.center, Icosphere(5).vertices).reciprocal()[None]
    true = index_from_depth(inverse_depth.reciprocal(), net.num_hypotheses, net.min_depth)
    noise = (0.06 * torch.randn(true.shape, generator=torch.Generator().manual_seed(0))).exp()

    def errors(hint: DepthHint | None) -> list[float]:
        error = (net.predict(images, rig, seen, hint).index - true).abs()
        return [float(error[where & (true <= 15)].mean()) for where in (seen.sum(1) >= 2, seen.sum(1) == 1)]

    every = torch.ones_like(true)
    with torch.inference_mode():
        by_two, by_one = errors(None)
        hinted_two, hinted_one = errors(DepthHint(inverse_depth * noise, every))
        wrong_two, wrong_one = errors(DepthHint(2.5 * inverse_depth, every))
        sparse = errors(
            DepthHint(inverse_depth, (torch.rand(true.shape, generator=torch.Generator()) < 0.05).float())
        )
    assert hinted_two < 0.8 * by_two
    assert hinted_one < 0.6 * by_one
    assert wrong_two < 1.1 * by_two
    assert wrong_one < 1.1 * by_one
    assert sparse[0] < by_two
    assert sparse[1] < by_one


@pytest.mark.parametrize("unknown", [9.0, math.nan, math.inf])
def test_a_hint_on_a_coarser_level_is_that_of_the_vertex_or_of_those_around_it(unknown):
    hint = DepthHint(torch.full((1, 162), unknown), torch.zeros(1, 162))
    ids = ids_of_coarser_level(2, 1)
    ring = icosphere_neighbors(2)[ids[20]]
    hint.weight[0, ids[3]], hint.inverse_depth[0, ids[3]] = 0.25, 2.0
    hint.weight[0, ring[:2]], hint.inverse_depth[0, ring[:2]] = (
        torch.tensor([0.2, 0.6]),
        torch.tensor([1.0, 2.0]),
    )
    beside = icosphere_neighbors(2)[ids[3], 0]
    hint.weight[0, beside], hint.inverse_depth[0, beside] = 0.75, 5.0  # what a vertex has of its own stays
    coarser = hint.coarser()
    assert (coarser.weight[0, 3], coarser.inverse_depth[0, 3]) == (0.25, 2.0)
    torch.testing.assert_close(coarser.inverse_depth[0, 20], torch.tensor(1.75))
    torch.testing.assert_close(coarser.weight[0, 20], torch.tensor(0.5))
    assert (coarser.weight[0] > 0).sum() < 10
