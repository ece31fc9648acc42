"""Strangers at the port of a live view: other pages, and messages that no page of ours sends."""

import asyncio
import threading
import time
import warnings

import numpy as np
import pytest

import hybridkin
from hybridkin import obstacles, robots
from hybridkin.app.workflow.model import tips_at

viser = pytest.importorskip("viser", reason='needs viser: pip install "hybridkin[view]"')
import msgspec  # noqa: E402 (viser brings them)
import websockets  # noqa: E402

NAN, INF = float("nan"), float("inf")
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "fov": 1.0,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
POSE = {
    "type": "TransformControlsUpdateMessage",
    "name": "/target",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.1, 0.1, 0.5],
    "owner": "",
}
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0.0, -2.0, 0.5],
    "ray_direction": [0.0, 1.0, 0.0],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}
VALUES = [None, [], {}, "", "1", "x" * 1000, b"\xff", True, -1, 2**62, NAN, INF, -INF, 1e300]
VALUES += [[1.0, 2.0], [1.0] * 4, [1.0] * 1000, [NAN] * 3, [None] * 3, ["a", "b", "c"], [[0.0]] * 3]
VALUES += [{"value": NAN}, {"value": 1e300}, {"removed": True}, {"props": {}}, {"props": None}]


@pytest.fixture
def shown():
    chain = robots.bionic_handling_assistant()
    with hybridkin.app.view(chain, q_min=0.1, q_max=0.4, port=9500) as view:
        yield view


def until(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def connected(view, act, origin=None):
    """Run an asynchronous function with a websocket of a browser's page, of the view by default."""

    async def run():
        async with websockets.connect(
            view.address.replace("http", "ws"),
            origin=origin or view.address,
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        ) as socket:
            return await act(socket)

    return asyncio.run(asyncio.wait_for(run(), 30.0))


def sending(*messages):
    async def act(socket):
        for message in (CAMERA, *messages):
            raw = message if isinstance(message, (bytes, str)) else msgspec.msgpack.encode(message)
            await socket.send(raw)
            if message is CAMERA:
                await asyncio.sleep(0.1)  # then it is a client
        await asyncio.sleep(0.3)
        return socket.close_code

    return act


def is_alive(view):
    """Steer the view from its page, and return whether the robot follows."""
    home = tips_at(view.robot.model, view.robot.domain.preferred[None])[0]
    goal = home + np.array([0.02, 0.0, 0.0])
    until(lambda: view.robot._resting)
    connected(view, sending({**POSE, "position": goal.tolist()}))
    until(lambda: np.linalg.norm(view.robot.x - goal) < 2e-3)
    return view._thread.is_alive() and view._failure is None


def test_the_page_itself_steers(shown):
    assert is_alive(shown)
    until(lambda: shown.robot._resting)  # it moves the sliders, too
    time.sleep(0.3)
    slider = shown._sliders[0]
    update = {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid, "updates": {"value": 0.2}}
    connected(shown, sending(update))
    until(lambda: abs(shown.robot.q[0] - 0.2) < 1e-3)


ORIGINS = [
    "http://evil.example",
    "https://127.0.0.1",
    "http://127.0.0.1:1",
    "http://127.0.0.1",
    "http://localhost:{port}",
    "http://127.0.0.1:{port}.evil.example",
    "http://evil.example@127.0.0.1:{port}",
    "http://[::1",
    "null",
    "file://",
]


def test_a_page_of_another_origin_is_closed_out_and_steers_nothing(shown):
    before = shown.robot.target.copy()
    heard = []

    async def act(socket):
        try:
            for message in (CAMERA, POSE, POSE, CAMERA):  # some are here before the refusal
                await socket.send(msgspec.msgpack.encode(message))
            while True:
                heard.append(await socket.recv())
        except websockets.ConnectionClosed as closed:
            return closed.rcvd.code

    port = shown.address.rpartition(":")[2]
    with pytest.warns(UserWarning, match="another origin") as caught:
        codes = [connected(shown, act, origin.format(port=port)) for origin in ORIGINS]
    assert codes == [1008] * len(ORIGINS)
    assert len(caught) == 1
    assert heard == []
    assert shown._server.get_clients() == {}
    assert (shown.robot.target == before).all()


@pytest.mark.parametrize(
    ("host", "may"),
    [
        ("127.0.0.1:9", True),
        ("localhost:8080", True),
        ("[::1]:8080", True),
        ("view.localhost:80", True),
        ("192.168.0.7:8080", True),
        ("evil.example:8080", False),
        ("localhost.evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("[::1", False),
        ("", False),
    ],
)
def test_a_domain_that_leads_here_is_refused(host, may):
    from hybridkin.plots.page_server import _Gate

    headers = websockets.Headers([("Host", host), ("Origin", f"http://{host}")])
    assert _Gate("127.0.0.1").may_connect(headers) == may
    twice = websockets.Headers([*headers.raw_items(), ("Host", host), ("Origin", "http://a")])
    assert not _Gate("127.0.0.1").may_connect(twice)


@pytest.mark.filterwarnings("default")
def test_no_message_of_a_stranger_ends_the_view(shown):
    """What the page never sends is ignored, is said once, and the connection goes on."""
    uuid = shown._sliders[0]._impl.uuid
    update = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": 0.2}}
    hostile = [b"", b"\xc1", b"\x80", "text", b"\x93" * 50_000, msgspec.msgpack.encode([1, 2])]
    for whole in (CAMERA, POSE, CLICK, update):
        for key in whole:
            hostile += [{**whole, key: value} for value in VALUES]
            hostile.append({k: v for k, v in whole.items() if k != key})
        hostile.append({**whole, "more": 1})
    updates = ["removed", "props", "value", "order", "_impl", "min", "step", "visible", "disabled"]
    for name in updates:
        hostile += [{**update, "updates": {name: value}} for value in VALUES]
    hostile += [{"type": name} for name in ("ShareUrlRequest", "Message", "RunJavascriptMessage")]
    rng = np.random.default_rng(0)
    for k in rng.permutation(len(hostile))[:100]:
        raw = hostile[k]
        raw = bytearray(raw if isinstance(raw, bytes) else msgspec.msgpack.encode(raw))
        for _ in range(3):
            if raw:
                raw[rng.integers(len(raw))] = rng.integers(256)
        hostile.append(bytes(raw))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert connected(shown, sending(*hostile)) is None  # not closed
        assert is_alive(shown)
    said = [str(w.message) for w in caught]
    assert said == ["The page sent what it never sends; it is ignored, also from now on."]
    assert not shown._sliders[0]._impl.removed
    assert np.isfinite(shown.robot.q).all()
    assert np.shape(shown._aim.position) == (3,)


@pytest.fixture
def among():
    chain = robots.bionic_handling_assistant()
    scene = [obstacles.Sphere([0.5, 0.0, 0.5], 0.05), obstacles.HalfSpace([0, 0, 1], -0.3)]
    with hybridkin.app.view(chain, q_min=0.1, q_max=0.4, obstacles=scene, port=9550) as view:
        yield view


def centers(view):
    return np.array([obstacle.center.tolist() for obstacle in view.robot.obstacles])


def drag_until(condition, view, *messages):
    """Send messages again, as a page does while it drags, until a condition holds."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        connected(view, sending(*messages))
        time.sleep(0.3)


def test_the_page_drags_obstacles_and_turns_none(among):
    drag = {**POSE, "name": "/obstacle 1", "position": [0.4, 0.1, 0.6]}
    start = {"type": "TransformControlsDragStartMessage", "name": "/obstacle 1"}
    end = {"type": "TransformControlsDragEndMessage", "name": "/obstacle 1"}
    messages = start, {**drag, "wxyz": [0.0, 1.0, 0.0, 0.0]}, end
    moved = [[0.4, 0.1, 0.6], [0.0, 0.0, -0.3]]
    drag_until(lambda: np.allclose(centers(among), moved), among, *messages)
    assert among._obstacles[0]._arrows.wxyz == pytest.approx([1.0, 0.0, 0.0, 0.0])
    # The arrows of a plane stand in the middle of what is drawn of it.
    floor = among._obstacles[1]
    lifted = np.add(floor._arrows.position, [0.0, 0.0, 0.1])
    drag = {**POSE, "name": "/obstacle 2", "position": lifted.tolist()}
    drag_until(lambda: np.allclose(centers(among)[1], [0.0, 0.0, -0.2]), among, drag)


@pytest.mark.filterwarnings("ignore:The page sent")
def test_no_message_of_a_stranger_moves_an_obstacle_out_of_the_world(among):
    before = centers(among)
    hostile = []
    places = {f"/obstacle {k + 1}": among._obstacles[k]._arrows.position for k in range(2)}
    places |= dict.fromkeys(["/obstacle 3", "/obstacle 1/surface"], np.zeros(3))
    for name, place in places.items():
        drag = {**POSE, "name": name, "position": place.tolist()}
        hostile += [{**drag, "position": value} for value in VALUES]
        hostile += [{**drag, "wxyz": value} for value in VALUES]
        hostile += [{**drag, "position": [far, 0.0, 0.0]} for far in (NAN, INF, 1e300, 1e8, 1e5)]
    assert connected(among, sending(*hostile)) is None
    np.testing.assert_array_equal(centers(among), before)
    assert among._obstacles[0]._arrows.position == pytest.approx(before[0])
    assert is_alive(among)


@pytest.mark.filterwarnings("ignore:The page sent")
def test_uploads_that_no_widget_asked_for_are_not_kept(shown):
    start = {
        "type": "FileTransferStartUpload",
        "source_component_uuid": shown._sliders[0]._impl.uuid,
        "transfer_uuid": "t",
        "filename": "f",
        "mime_type": "m",
        "part_count": 2,
        "size_bytes": 20_000_000,
    }
    part = {
        "type": "FileTransferPart",
        "source_component_uuid": start["source_component_uuid"],
        "transfer_uuid": "t",
        "part_index": 0,
        "content": bytes(10_000_000),
    }
    kept = []

    async def act(socket):
        for message in (CAMERA, start, part):
            await socket.send(msgspec.msgpack.encode(message))
        await asyncio.sleep(0.5)
        kept.append(dict(shown._server.gui._current_file_upload_states))

    connected(shown, act)
    assert kept == [{}]
    assert is_alive(shown)


@pytest.mark.filterwarnings("ignore:The page sent")
def test_nobody_shares_the_view_in_the_internet(shown, monkeypatch):
    asked = threading.Event()
    monkeypatch.setattr(shown._server, "request_share_url", asked.set)
    connected(shown, sending({"type": "ShareUrlRequest"}))
    assert not asked.is_set()


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch):
    monkeypatch.delattr(viser.infra.WebsockServer, "disconnect_all_clients")
    with pytest.raises(RuntimeError, match="cannot be kept to its own page"):
        hybridkin.app.view(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4, port=9600)


def test_names_of_actuators_are_text_on_the_page(tmp_path):
    name = "<img src=x onerror=alert(1)> {alert(1)} [a](javascript:alert(1))\n# b\x1b"
    quoted = '"<img src=x onerror=alert(1)> {alert(1)} [a](javascript:alert(1))\\n# b\\u001b"'
    path = tmp_path / "robot.toml"
    path.write_text(
        "[[segment]]\nradius = 0.005\nlength = 0.1\ngain = 0.001\n[log]\n"
        f'q = [{quoted}, "b", "c"]\nx = ["x", "y", "z"]\nq_unit = "counts"\n'
        '[limits]\nq_min = 0.0\nq_max = 1.0\nunit = "log"\n'
    )
    model = hybridkin.open_model(path)
    with hybridkin.app.view(model, port=9700) as shown:
        shown.go_to(np.zeros(3))
        until(lambda: "at limits: `<img`" in shown._words.content)
        assert "`{alert(1)}`" in shown._words.content
        assert name not in shown._words.content
        assert "\n" not in shown._sliders[0].label
        assert "\x1b" not in shown._words.content + shown._sliders[0].label
