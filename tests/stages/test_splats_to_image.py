"""Pictures of splats: one splat by hand, a float64 reference, any number of threads, lenses, and hostile values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Splats, memory_limit, orbit_cameras, render_splats
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels import parallel
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import look_at
from nerfbake.scene.lens import Lens
from tests.support.splat_pictures import reference_picture
from tests.support.splats import splats

SH0 = 0.28209479177387814


def one_splat(**changes: object) -> Splats:
    """A red ball with a standard deviation of 0.5 at z = -5."""
    arrays: dict[str, np.ndarray] = {
        "means": np.array([[0, 0, -5]]),
        "scales": np.full((1, 3), 0.5),
        "quats": np.array([[1, 0, 0, 0]]),
        "opacity": np.array([0.5]),
        "sh": np.array([[[0.5, -0.5, -0.5]]]) / SH0,
    }
    arrays.update(changes)  # type: ignore[arg-type]
    means, scales, quats, opacity, sh = (np.asarray(value, np.float32) for value in arrays.values())
    return Splats(means, scales, quats, opacity, sh)


def ring(number: int = 0, **changes: object) -> Camera:
    """A camera around splats(), which stand around the origin."""
    camera = Camera(75, 52, 60.0, look_at(np.zeros(3), 0.8 * number, 0.3, 6.0), str(number))
    return replace(camera, **changes)  # type: ignore[arg-type]


def test_one_splat_by_hand() -> None:
    # The optical axis meets the centre of pixel 4, 4. A pixel is 5 / 10 = 0.5 wide at the splat: its variance is
    # 1 + 0.3 square pixels.
    camera = Camera(9, 9, 10.0, np.eye(4))
    image = render_splats(one_splat(), camera, background=None)
    assert_allclose(image.alpha[4, 4], 0.5, rtol=1e-6)
    assert_allclose(image.alpha[4, 3], 0.5 * np.exp(-0.5 / 1.3), rtol=3e-6)
    assert_allclose(image.alpha[5, 6], 0.5 * np.exp(-2.5 / 1.3), rtol=3e-6)
    assert image.alpha[4, 8] == 0  # 0.5 e^(-8 / 1.3) is below 1 / 255
    assert_allclose(image.colour[4, 4], [0.5, 0, 0], atol=1e-6)
    assert_allclose(image.depth[4, [4, 7]], [5, 5 * np.sqrt(1 + 0.3**2)], rtol=1e-6)
    assert image.depth[4, 8] == 0
    over_blue = render_splats(one_splat(), camera, background=(0, 0, 1))
    assert_allclose(over_blue.colour[4, 4], [0.5, 0, 0.5], atol=1e-6)


def test_a_quaternion_turns_the_long_axis() -> None:
    # Long along its own x; turned by 90 degrees about z, it is long along the picture's y.
    long = one_splat(scales=[[1, 0.1, 0.1]], quats=[[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])
    alpha = render_splats(long, Camera(9, 9, 10.0, np.eye(4))).alpha
    assert_allclose(alpha[2, 4], 0.5 * np.exp(-2 / 4.3), rtol=3e-6)
    assert_allclose(alpha[4, 5], 0.5 * np.exp(-0.5 / 0.34), rtol=3e-6)


def test_antialiased_splats_keep_their_mass() -> None:
    # A standard deviation of 0.4 pixels: the sum of alpha is 2 pi o s^2, less the 2 % that are below 1 / 255.
    small, camera = one_splat(scales=[[0.2] * 3]), Camera(9, 9, 10.0, np.eye(4))
    whole = 2 * np.pi * 0.5 * 0.4**2
    assert_allclose(render_splats(replace(small, antialiased=True), camera).alpha.sum(), 0.98 * whole, rtol=0.02)
    assert render_splats(small, camera).alpha.sum() > 2.5 * whole


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_reference_agrees(degree: int, antialiased: bool) -> None:
    scene = splats(400, degree=degree, seed=degree, antialiased=antialiased)
    scene = replace(scene, scales=scene.scales * 6)
    for number in range(3):
        camera = ring(number, focal=(60.0, 66.0), centre=(33.0, 30.0))
        image = render_splats(scene, camera, background=(0.2, 0.5, 0.8))
        colour, alpha, depth = reference_picture(scene, camera, (0.2, 0.5, 0.8))
        assert psnr(image.colour.astype(np.float64), np.minimum(colour, 1)) > 90
        assert psnr(image.alpha.astype(np.float64), alpha) > 90
        shown = alpha > 0.1
        assert_allclose(image.depth[shown], depth[shown], rtol=1e-3)


def test_opaque_splats_hide_what_is_behind() -> None:
    scene = splats(800, degree=1, seed=7)
    scene = replace(scene, scales=scene.scales * 20, opacity=np.full(scene.n, 0.999, np.float32))
    image, (colour, alpha, _) = render_splats(scene, ring()), reference_picture(scene, ring())
    assert (alpha > 1 - 1.2e-4).mean() > 0.2  # many pixels are closed, and none below the least transmittance
    assert image.alpha.max() <= 1 - 1e-4
    assert psnr(image.colour.astype(np.float64), np.minimum(colour, 1)) > 90


def test_a_camera_amid_the_splats() -> None:
    # Splats beside and behind the camera: the culling at 0.01, and the clamp of the Jacobian.
    scene = splats(500, degree=1, seed=3)
    camera = ring(pose=look_at(np.zeros(3), 0.1, 0.2, 0.05))
    image, (colour, *_) = render_splats(scene, camera), reference_picture(scene, camera)
    assert psnr(image.colour.astype(np.float64), np.minimum(colour, 1)) > 90


@pytest.mark.parametrize("lens", [Lens("polynomial", (-0.15, 0.02), (0.01, -0.02)), Lens("fisheye", (0.05,))])
def test_a_lens_moves_the_pixels(lens: Lens) -> None:
    scene, camera = splats(400, degree=1, seed=5), ring(lens=lens)
    scene = replace(scene, scales=scene.scales * 6)
    image = render_splats(scene, camera)
    plane = camera.plane()
    assert plane is not None
    places = plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    colour, _, depth = reference_picture(scene, camera, places=places)
    assert psnr(image.colour.astype(np.float64), np.minimum(colour, 1)) > 90
    assert psnr(render_splats(scene, ring()).colour.astype(np.float64), np.minimum(colour, 1)) < 40
    assert_allclose(image.depth[depth > 0], depth[depth > 0], rtol=1e-3)
    # The ball of test_one_splat_by_hand() is where a field would show it: where the ray of its direction is.
    _, rays = camera.rays()
    ahead = int(np.argmax(rays @ -camera.pose[:3, 2]))
    ball = render_splats(one_splat(means=[[0, 0, 0]]), camera)
    assert ball.alpha.reshape(-1)[ahead] == ball.alpha.max()


def test_a_lens_that_looks_backwards_is_refused() -> None:
    wide = Camera(20, 20, 5.0, np.eye(4), "wide", lens=Lens("fisheye"))
    with pytest.raises(InvalidScene, match="camera wide looks backwards through its lens"):
        render_splats(one_splat(), wide)


def test_the_length_of_the_pose_s_axes_has_no_effect() -> None:
    scene, camera = splats(200, seed=2), ring()
    pose = camera.pose.copy()
    pose[:3, :3] *= 4
    assert_array_equal(render_splats(scene, replace(camera, pose=pose)).depth, render_splats(scene, camera).depth)


def test_samples_have_no_effect() -> None:
    scene = splats(50)
    assert_array_equal(render_splats(scene, ring(), samples=2).colour, render_splats(scene, ring()).colour)
    with pytest.raises(InvalidScene, match="samples are 9"):
        render_splats(scene, ring(), samples=9)


def test_equal_depths_keep_the_order_of_the_rows() -> None:
    two = one_splat(
        means=[[0, 0, -5]] * 2,
        scales=np.full((2, 3), 0.5),
        quats=[[1, 0, 0, 0]] * 2,
        opacity=[0.5, 0.5],
        sh=np.array([[[0.5, -0.5, -0.5]], [[-0.5, 0.5, -0.5]]]) / SH0,
    )
    colour = render_splats(two, Camera(9, 9, 10.0, np.eye(4)), background=None).colour
    assert_allclose(colour[4, 4], [0.5, 0.25, 0], atol=1e-6)


def test_a_far_pixel_of_a_large_picture_is_exact() -> None:
    # 30,000 pixels from the corner, float32 has steps of 0.002 pixels.
    camera = Camera(40, 40, 20000.0, np.eye(4), centre=(-30000.25, 20.0))
    scene = one_splat(means=[[7.5050625, 0, -5]], scales=[[0.0002] * 3])
    image, (_, alpha, _) = render_splats(scene, camera), reference_picture(scene, camera)
    assert alpha.max() > 0.3
    assert_allclose(image.alpha, alpha, atol=2e-5)


def test_huge_and_empty_splats_are_drawn_or_left_out() -> None:
    one = [[1, 0, 0, 0]]
    for scale in (0, 1e-20, 77, 1e8, 1e15):
        for mean in ([0, 0, -5], [1e15, 0, -1e15], [0, 0, 5], [1e15, 1e15, -0.02]):
            scene = one_splat(means=[mean], scales=[[scale, scale, 0]], quats=one, opacity=[1.0])
            image, (_, alpha, _) = (
                render_splats(scene, ring(pose=np.eye(4))),
                reference_picture(scene, ring(pose=np.eye(4))),
            )
            assert np.isfinite(image.colour).all()
            assert_allclose(image.alpha, alpha, atol=1e-4)
    assert render_splats(one_splat(opacity=[0]), ring(pose=np.eye(4))).alpha.max() == 0


def test_what_cannot_be_drawn_is_one_line() -> None:
    with pytest.raises(InvalidScene, match=r"opacity.*is 1\.5"):
        render_splats(one_splat(opacity=[1.5]), ring())
    with memory_limit(300_000), pytest.raises(MemoryLimit, match="projecting"):
        render_splats(splats(2000), ring())


def test_the_same_bytes_with_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, found = splats(5000), []
    for threads in (1, 2, 5):
        monkeypatch.setattr(parallel, "cores", lambda threads=threads: threads)
        found.append(render_splats(scene, ring()))
    for other in found[1:]:
        for name in ("colour", "alpha", "depth"):
            assert_array_equal(getattr(other, name), getattr(found[0], name))


def test_strays_do_not_move_the_cameras() -> None:
    scene = splats(1000)
    strays = replace(scene, means=np.where(np.arange(1000)[:, None] < 5, np.float32(1e6), scene.means))
    (camera,), (other,) = (orbit_cameras(each, width=8, height=8).cameras for each in (scene, strays))
    assert_allclose(camera.pose[:3, 3], other.pose[:3, 3], atol=1)
    assert camera.pose[1, 3] < 0 < camera.pose[1, 1] * -1  # above the object, whose y axis points down
    lone = orbit_cameras(one_splat(), width=8, height=8).cameras[0]
    assert render_splats(one_splat(), lone).alpha[4, 4] > 0.3
