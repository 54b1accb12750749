"""A thread that renders groups of lights ahead of their requests."""

import threading
import time

import numba
import pytest

from rigsim.scenes.dome.ahead import RenderAhead

GROUPS = [(f"C0{k}", (k,)) for k in range(6)]


def wait_until(condition) -> None:
    end_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(1e-3)


def test_groups_after_first_request_follow_in_order():
    done, threads = [], []

    def render(group):
        done.append(group)
        threads.append((threading.current_thread().name, numba.get_num_threads()))

    with RenderAhead(GROUPS, render) as ahead:
        ahead.begin_after(GROUPS[1])
        ahead.begin_after(GROUPS[4])  # the earlier groups are under way, or finished
        wait_until(lambda: len(threads) >= 4 and not ahead._is_busy)
    assert done[:4] == GROUPS[2:]
    assert set(threads) == {("images of lights", numba.get_num_threads())}


def test_groups_wait_without_a_request():
    done = []
    with RenderAhead(GROUPS, done.append) as ahead:
        ahead.begin_after(("C09", (0,)))  # not one of them
        time.sleep(0.02)
    assert not done


def test_request_and_group_never_render_together():
    inside, most = [], []

    def render(_):
        inside.append(1)
        most.append(len(inside))
        time.sleep(1e-3)
        inside.pop()

    with RenderAhead(GROUPS * 20, render) as ahead:
        ahead.begin_after(GROUPS[0])
        for _ in range(30):
            with ahead.exclusive():
                render(None)
    assert max(most) == 1


def test_request_goes_before_next_group():
    done, started, go_on = [], threading.Event(), threading.Event()

    def render(group):
        started.set()
        go_on.wait(10.0)
        done.append(group)

    with RenderAhead(GROUPS, render) as ahead:
        ahead.begin_after(GROUPS[0])
        assert started.wait(10.0)
        threading.Timer(0.05, go_on.set).start()
        with ahead.exclusive():
            done.append("request")
        wait_until(lambda: len(done) == 6)
    assert done == [GROUPS[1], "request", *GROUPS[2:]]


def test_failing_group_ends_work_ahead_with_warning(caplog):
    done = []

    def render(group):
        done.append(group)
        raise MemoryError("no memory")

    with RenderAhead(GROUPS, render) as ahead:
        ahead.begin_after(GROUPS[0])
        wait_until(lambda: done and not ahead._is_busy)
    assert done == GROUPS[1:2]
    assert "no memory" in caplog.text
    assert "in render" in caplog.text, "the stack is lost"


def test_end_of_thread_lets_requests_render(monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda _: None)

    def render(_):
        raise SystemExit

    def request() -> None:
        with ahead.exclusive():
            done.append("request")

    done = []
    with RenderAhead(GROUPS, render) as ahead:
        ahead.begin_after(GROUPS[0])
        ahead._thread.join(20.0)
        other = threading.Thread(target=request, daemon=True)
        other.start()
        other.join(5.0)
    assert done == ["request"]


def test_interrupted_request_lets_later_groups_render(monkeypatch):
    done, started, go_on = [], threading.Event(), threading.Event()

    def render(group):
        started.set()
        go_on.wait(10.0)
        done.append(group)

    def interrupt(_):
        raise KeyboardInterrupt

    with RenderAhead(GROUPS, render) as ahead:
        ahead.begin_after(GROUPS[0])
        assert started.wait(10.0)
        with monkeypatch.context() as patch:
            patch.setattr(ahead._changed, "wait_for", interrupt)
            with pytest.raises(KeyboardInterrupt), ahead.exclusive():
                pass
        go_on.set()
        wait_until(lambda: done == GROUPS[1:])


def test_threads_of_numbas_own_pool_render_nothing(monkeypatch):
    monkeypatch.setattr("rigsim.scenes.dome.ahead.threading_layer", lambda: "workqueue")
    done = []
    with RenderAhead(GROUPS, done.append) as ahead:
        ahead.begin_after(GROUPS[0])
        time.sleep(0.02)
    assert not done


def test_end_waits_for_the_group_at_work():
    done = []

    def render(group):
        time.sleep(0.05)
        done.append(group)

    def stop(ahead: RenderAhead) -> None:
        with ahead:
            ahead.begin_after(GROUPS[0])
            while not ahead._is_busy:
                time.sleep(1e-3)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop(RenderAhead(GROUPS, render))
    count = len(done)
    time.sleep(0.1)
    assert len(done) == count < 5
