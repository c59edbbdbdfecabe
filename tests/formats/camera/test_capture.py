"""Names that files declare become names of files: safe, each its own, and the same every time."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from nerfbake.formats.camera.capture import MAX_NAME, inside_of, names_of


def test_names_by_hand() -> None:
    paths = [
        "./train/r_0",
        "images\\a.JPG",
        "q.png.png",
        "v1.5",
        "frame 3 (2).jpeg",
        None,
        "",
        "..",
        "/",
        "-",
        ".",
        "...png",
    ]
    expected = ["r_0", "a", "q.png", "v1.5", "frame 3 (2)", *(f"{i:04d}" for i in range(5, 12))]
    assert names_of(paths) == expected
    odd = ["a\0b", "a\nb\x1b[2J", "-rf", ".hidden", "a:b*c?", "\ud800x", "é", "a/b\u202egnp"]
    assert names_of(["Ku\u0308che", "K\u00fcche"]) == ["Küche", "Küche_0001"]  # decomposed and composed
    assert names_of(odd) == ["a_b", "a_b_[2J", "_rf", "_hidden", "a_b_c_", "_x", "é", "b_gnp"]


def test_a_picture_stands_in_its_capture_or_nowhere() -> None:
    inside = {
        "a": "a",
        "./train/r_0": "train/r_0",
        "images\\a.JPG": "images/a.JPG",
        "a//./b": "a/b",
        "..a/b..": "..a/b..",
        "影" * 85: "影" * 85,  # 255 bytes
        "新しい\u3000フォルダ/Screenshot 3.45\u202fPM.png": "新しい\u3000フォルダ/Screenshot 3.45\u202fPM.png",
    }
    assert {path: inside_of(path) for path in inside} == inside
    outside = (
        None,
        "",
        ".",
        "./",
        "/",
        "/etc/a.png",
        "\\a",
        "../a.png",
        "a/../b",
        "..",
        "a\\..\\..\\b",
        "a\0b",
        "a\nb",
        "a\u2028b",
        "a\u202egnp",
        "\ud800",
    )
    assert {inside_of(path) for path in (*outside, "a" * 1001, "é" * 256)} == {""}


def test_equal_names_get_their_numbers() -> None:
    assert names_of(["train/a.png", "test/a.png", "a_0001", "a"]) == ["a", "a_0001", "a_0001_0002", "a_0003"]


@given(
    st.lists(st.one_of(st.none(), st.text(max_size=300), st.sampled_from(["a", "A.png", "a" * 500, "é" * 500, "/"])))
)
def test_any_names_at_all(paths: list[str | None]) -> None:
    names = names_of(paths)
    assert names == names_of(paths)
    assert len(set(names)) == len(names)
    for name in names:
        assert name.isprintable()
        assert name[0] not in ".-"
        assert not {"/", "\\", "\0"} & set(name)
        assert len(f"{name}.depth.npy".encode()) <= MAX_NAME + 40
