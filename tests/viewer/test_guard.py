"""The gate of the viewer: who is let in, what may be said, and what is left of a thousand hostile connections."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gs2d.io.formats.registry import write_layout

pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
import hostile_clients
from gs2d.viewer.guard import Guard, problem_of
from served_viewer import Served, random_splats
from viser_client import Client


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    path = tmp_path_factory.mktemp("viewer") / "a.ply"
    write_layout(path, random_splats(2000), "2dgs")
    running = Served(path)
    yield running
    running.end()


# -- who is let in -----------------------------------------------------------------------------------------------------
def test_the_page_and_its_scene_are_for_those_who_know_the_token(served: Served) -> None:
    bare, _, query = served.url.partition("?")
    assert query.startswith("token=")
    assert hostile_clients.page_status(bare) == 403
    assert hostile_clients.page_status(bare + "?token=guess") == 403
    assert hostile_clients.page_status(served.url) == 200
    assert hostile_clients.status_of(bare) == 403
    assert hostile_clients.status_of(bare + "?token=guess") == 403
    assert hostile_clients.status_of(served.url) == 101


def test_the_page_keeps_the_token_as_a_cookie_that_other_sites_do_not_send(served: Served) -> None:
    import urllib.request

    bare = served.url.partition("?")[0]
    with urllib.request.urlopen(served.url, timeout=60) as page:
        cookie = page.headers["Set-Cookie"]
        assert page.headers["Referrer-Policy"] == "no-referrer"
        assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    pair = cookie.partition(";")[0]
    assert hostile_clients.page_status(bare, Cookie=pair) == 200
    assert hostile_clients.status_of(bare, additional_headers={"Cookie": pair}) == 101
    assert hostile_clients.status_of(bare, additional_headers={"Cookie": pair + "x"}) == 403


def test_a_foreign_page_gets_no_scene_even_with_the_token(served: Served) -> None:
    own = served.url.partition("/?")[0]
    for origin in ("http://evil.example", "http://127.0.0.1:1", "null"):
        assert hostile_clients.status_of(served.url, origin=origin) == 403
    assert hostile_clients.status_of(served.url, origin=own) == 101


def test_more_browsers_than_there_is_room_for_are_refused(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    guard = Guard()
    headers = {"Upgrade": "websocket", "Host": "h"}
    assert guard.refusal(f"/?token={guard.token}", headers) is None
    monkeypatch.setattr(guard, "_clients", 16)
    assert guard.refusal(f"/?token={guard.token}", headers) == 503


# -- what may be said --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", hostile_clients.MESSAGES)
def test_what_cannot_be_read_ends_its_connection(name: str) -> None:
    problem = problem_of(hostile_clients.MESSAGES[name], lambda uuid: SimpleNamespace(value=True))
    assert problem or name == "too long", name  # that one is too long for the library already
    assert problem is None or problem.isprintable()


def test_what_the_page_says_is_passed_on_and_the_rest_of_the_library_is_not() -> None:
    for data in hostile_clients.DROPPED.values():
        assert problem_of(data, lambda uuid: None) == ""
    assert problem_of(hostile_clients.packed(), lambda uuid: None) is None
    assert (
        problem_of(hostile_clients.packed(position=[1, 2, 3]), lambda uuid: None) is None
    )  # whole numbers are shorter


@pytest.mark.parametrize(
    ("handle", "good", "bad"),
    [
        ({"value": True}, [False], [1, "no", None, float("nan")]),
        ({"value": "a", "options": ("a", "b")}, ["b"], ["c", 1, None, ["a"]]),
        ({"value": 1.0, "min": 0.1, "max": 4.0}, [0.1, 4, 2.5], [5.0, -1, True, "1", float("nan"), [1.0]]),
        (
            {"value": (0.0, 1.0), "min": -1.0, "max": 1.0},
            [[0, 1], [-1.0, 1.0]],
            [[0.0], [0.0, float("inf")], 0.0, [2, 2]],
        ),
    ],
)
def test_a_widget_gets_only_what_it_can_hold(handle: dict[str, Any], good: list[Any], bad: list[Any]) -> None:
    def problem(value: Any) -> str | None:
        data = hostile_clients.message("GuiUpdateMessage", uuid="u", updates={"value": value})
        return problem_of(data, lambda uuid: SimpleNamespace(**handle) if uuid == "u" else None)

    assert [problem(value) for value in good] == [None] * len(good)
    assert all(problem(value) for value in bad)


def test_a_client_without_a_camera_does_not_end_the_exact_pictures(served: Served) -> None:
    browser = Client(served.url)
    browser.choose("splats", "exact")
    browser.wait(lambda: browser.counts["BackgroundImageMessage"] > 0)
    for name in ("camera: nan", "camera: no turn", "camera: infinite angle"):
        assert hostile_clients.say(served.url, hostile_clients.MESSAGES[name], patience=60) == 1008, name
    before = browser.counts["BackgroundImageMessage"]
    browser.look_from((0.5, -2.0, 1.0))
    browser.wait(lambda: browser.counts["BackgroundImageMessage"] > before)
    browser.choose("splats", "preview")
    browser.close()


# -- what is left ------------------------------------------------------------------------------------------------------
def besieged(served: Served, count: int, growth: float) -> None:
    assert served.is_alive()
    before = served.memory()
    assert hostile_clients.attack(served.url, count) == count
    assert served.is_alive()
    assert served.memory() - before < growth, (before, served.memory())


@pytest.mark.timeout(400)
def test_hostile_connections_leave_the_server_alive_silent_and_as_large_as_it_was(served: Served) -> None:
    besieged(served, 44, 25.0)  # each once, and what is loaded once
    said = served.end()  # the last test of the module that needs it
    assert "Traceback" not in said
    assert "\x1b[31mNoSuch" not in said
    assert said.strip().splitlines()[-1] == "interrupted"


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_thousand_hostile_connections_and_a_thousand_good_ones(tmp_path: Path) -> None:
    write_layout(tmp_path / "a.ply", random_splats(2000), "2dgs")
    served = Served(tmp_path / "a.ply")
    try:
        hostile_clients.attack(served.url, 50)  # what is loaded once
        besieged(served, 1000, 40.0)
        before = served.memory()
        for _ in range(1000):
            browser = Client(served.url)
            browser.wait(lambda browser=browser: browser.counts["GaussianSplatsMessage"] > 0)  # type: ignore[misc]
            browser.close()
        assert served.memory() - before < 40.0, (before, served.memory())
    finally:
        said = served.end()
    assert "Traceback" not in said
