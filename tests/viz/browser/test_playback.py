import pytest

from torchface.viz.browser.playback import Playback


def test_every_frame_is_due_exactly_at_its_own_time() -> None:
    playback = Playback(frames=1846, fps=59.94, loop=False).play(1234.5)
    assert [playback.frame(1234.5 + frame / 59.94) for frame in range(1846)] == list(range(1846))


def test_loop_begins_again_and_the_end_holds() -> None:
    playing = Playback(frames=10, fps=10).play(0.0)
    assert [playing.frame(second) for second in (0.95, 1.0, 2.35)] == [9, 0, 3]
    once = Playback(frames=10, fps=10, loop=False).play(0.0)
    assert once.frame(50.0) == 9
    assert once.ended(50.0)
    assert not once.ended(0.5)
    assert not playing.ended(50.0)


def test_pause_seek_and_speed_keep_the_frame() -> None:
    playing = Playback(frames=100, fps=10).play(0.0)
    paused = playing.pause(3.05)
    assert paused.frame(99.0) == 30
    assert paused.play(7.0).frame(7.5) == 35
    slow = playing.paced(3.0, speed=0.25)
    assert (slow.frame(3.0), slow.frame(5.0)) == (30, 35)
    assert playing.seek(80, 3.0).frame(3.5) == 85
    assert paused.seek(1000, 0.0).frame(50.0) == 99


def test_play_at_the_end_begins_anew() -> None:
    assert Playback(frames=10, fps=10, loop=False, origin=9).play(0.0).frame(0.25) == 2


@pytest.mark.parametrize("frame", [0, 3])
def test_a_take_of_one_frame_stays_there(frame: int) -> None:
    assert Playback(frames=1, fps=60).seek(frame, 0.0).play(0.0).frame(10.0) == 0


def test_frames_at_uneven_times_are_due_at_these() -> None:
    times = (0.0, 0.1, 0.5, 0.6)
    playing = Playback(frames=4, fps=10.0, times=times).play(now=100.0)
    assert [playing.frame(100 + time) for time in times] == [0, 1, 2, 3]
    assert [playing.frame(100 + time) for time in (0.09, 0.49, 0.59, 0.69)] == [0, 1, 2, 3]
    assert playing.frame(100.75) == 0  # the last frame lasts a tenth of a second
    fast = Playback(4, 10.0, speed=2.0, loop=False, times=times).play(now=0.0)
    assert [fast.frame(now) for now in (0.26, 0.29, 0.31, 5.0)] == [2, 2, 3, 3]
    assert playing.seek(2, now=7.0).frame(7.09) == 2
    assert playing.seek(2, now=7.0).frame(7.11) == 3
