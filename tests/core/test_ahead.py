"""A stream made one item ahead is the same stream."""

from __future__ import annotations

import threading

import pytest

from mtpcr_geo.core.ahead import ahead
from mtpcr_geo.core.system import cores, usable_cores


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_same_items_in_the_same_order(threads, count, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.core.ahead.usable_cores", lambda: threads)
    assert list(ahead(iter(range(count)))) == list(range(count))


def test_no_more_than_one_item_is_made_ahead(monkeypatch):
    monkeypatch.setattr("mtpcr_geo.core.ahead.usable_cores", lambda: 2)
    made: list[int] = []
    third = threading.Event()

    def items():
        for i in range(10):
            made.append(i)
            if i == 2:
                third.set()
            yield i

    stream = ahead(items())
    assert next(stream) == 0
    assert made == [0]
    assert next(stream) == 1
    assert third.wait(30)
    assert made == [0, 1, 2]
    stream.close()
    assert made == [0, 1, 2]


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_comes_where_its_item_would_have_come_and_the_stream_is_closed(threads, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.core.ahead.usable_cores", lambda: threads)
    closed = []

    def items():
        try:
            yield from range(3)
            raise ValueError("damaged")
        finally:
            closed.append(True)

    seen: list[int] = []
    stream = ahead(items())
    with pytest.raises(ValueError, match="damaged"):
        seen.extend(stream)
    assert seen == [0, 1, 2]
    assert closed == [True]


@pytest.mark.parametrize("threads", [1, 2])
def test_a_stream_left_early_is_closed(threads, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.core.ahead.usable_cores", lambda: threads)
    closed = []

    def items():
        try:
            yield from range(100)
        finally:
            closed.append(threading.current_thread() is threading.main_thread())

    stream = ahead(items())
    assert [next(stream), next(stream)] == [0, 1]
    stream.close()
    assert closed == [True]


def test_cores_are_limited_meanwhile_and_not_after():
    import cv2

    before, of_opencv = usable_cores(), cv2.getNumThreads()
    with cores(1):
        assert usable_cores() == 1
        assert cv2.getNumThreads() == 1
        with cores(0):
            assert usable_cores() == 1
    assert usable_cores() == before
    assert cv2.getNumThreads() == of_opencv
