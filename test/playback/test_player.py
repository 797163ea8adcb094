"""The player without ROS: order, pace, pause, step, seek and loop of a timeline made by hand."""

import itertools
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.player import Ending, Item, PlayClock, Player
from semiparam_ros.playback.read_ahead import ReadAhead

MS = 1_000_000
ARRIVES_S = 10.0


class Score:
    """A timeline of messages ``spacing`` ns apart, numbered by their bytes."""

    def __init__(self, count, spacing=MS, start=5_000_000_000):
        self.items = [Item(start + k * spacing, '/t', bytes([k])) for k in range(count)]
        self.start_ns, self.end_ns = self.items[0].time, self.items[-1].time

    def play(self, from_ns):
        return (item for item in self.items if item.time >= from_ns)


class Stage:
    """Runs a player in a thread of its own and lets a test wait for what it publishes."""

    def __init__(self, timeline, **options):
        self.heard = []
        self.changed = threading.Condition()
        self.player = Player(timeline, self.hear, **options)
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.ending = None

    def run(self):
        self.ending = self.player.run()

    def hear(self, item):
        with self.changed:
            self.heard.append(item.raw[0])
            self.changed.notify_all()

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.player.stop()
        self.thread.join(ARRIVES_S)
        assert not self.thread.is_alive()

    def wait_for(self, count):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.heard) >= count, ARRIVES_S), self.heard

    def join(self):
        self.thread.join(ARRIVES_S)
        assert not self.thread.is_alive()


def test_everything_is_played_in_order_and_at_its_time():
    times = []
    score = Score(20, spacing=5 * MS)
    player = Player(score, lambda item: times.append(time.monotonic_ns()), rate=2.0)
    began = time.monotonic_ns()
    assert player.run() is Ending.FINISHED
    due = [(item.time - score.start_ns) / 2.0 for item in score.items]
    assert all(at - began >= wanted for at, wanted in zip(times, due, strict=True))
    assert player.published == 20 and player.now() == score.end_ns


def test_the_bag_time_does_not_run_before_the_first_message_is_read():
    """It would go back then, and nodes on simulated time would begin anew."""
    clock, seen = itertools.count(0, 7 * MS), []
    score = Score(20)

    class SlowToOpen:
        start_ns, end_ns = score.start_ns, score.end_ns

        def play(self, from_ns):
            seen.extend(player.now() for _ in range(5))
            yield from score.play(from_ns)

    player = Player(SlowToOpen(), lambda item: seen.append(player.now()), monotonic=lambda: next(clock))
    assert player.run() is Ending.FINISHED
    assert seen[:5] == [score.start_ns] * 5 and seen == sorted(seen) and seen[-1] > score.start_ns


def test_unpaced_playback_does_not_wait():
    score = Score(100, spacing=3600 * 10**9)
    heard = []
    assert Player(score, lambda item: heard.append(item.raw[0]), rate=None).run() is Ending.FINISHED
    assert heard == list(range(100))


def test_a_paused_start_publishes_nothing_until_it_is_stepped_and_resumed():
    with Stage(Score(5), paused=True) as stage:
        stage.player.step()
        stage.player.step()
        stage.wait_for(2)
        assert stage.heard == [0, 1] and stage.player.now() == stage.player._timeline.items[1].time
        stage.player.set_paused(False)
        stage.join()
    assert stage.heard == [0, 1, 2, 3, 4] and stage.ending is Ending.FINISHED


def test_only_a_paused_playback_is_stepped():
    with pytest.raises(SemiparamError, match='pause it first'):
        Player(Score(2), lambda item: None).step()


def test_pausing_stops_the_bag_time_and_costs_no_message():
    with Stage(Score(50)) as stage:
        stage.wait_for(5)
        stage.player.set_paused(True)
        held = stage.player.now()
        assert stage.player.now() == held
        stage.player.set_paused(False)
        stage.join()
    assert stage.heard == list(range(50))


@pytest.mark.parametrize(('target', 'expected'), [(7, [0, 7, 8, 9]), (0, [0, *range(10)])])
def test_seeking_goes_on_from_there(target, expected):
    score = Score(10)
    with Stage(score, paused=True) as stage:
        stage.player.step()
        stage.wait_for(1)
        stage.player.seek(score.items[target].time)
        stage.player.set_paused(False)
        stage.join()
    assert stage.heard == expected


def test_seeking_outside_is_refused_with_the_range():
    player = Player(Score(11, 100 * MS), lambda item: None)
    with pytest.raises(SemiparamError, match=r'seek to 2\.000 s: the playback lasts from 0 to 1\.000 s'):
        player.seek(player._timeline.start_ns + 2_000 * MS)


def test_a_loop_plays_again_until_it_is_stopped():
    with Stage(Score(3), loop=True) as stage:
        stage.wait_for(7)
    assert stage.heard[:7] == [0, 1, 2, 0, 1, 2, 0] and stage.ending is Ending.STOPPED


def test_a_loop_of_nothing_is_an_error_and_no_endless_loop():
    score = Score(3)
    score.items = []
    with pytest.raises(SemiparamError, match='nothing to loop'):
        Player(score, lambda item: None, loop=True).run()


def test_stop_ends_a_playback_that_waits_for_a_far_message():
    with Stage(Score(2, spacing=3600 * 10**9)) as stage:
        stage.wait_for(1)
        stage.player.stop()
        stage.join()
    assert stage.ending is Ending.STOPPED and stage.heard == [0]


def test_a_new_rate_holds_at_once_for_a_message_that_is_waited_for():
    with Stage(Score(2, spacing=3600 * 10**9)) as stage:
        stage.wait_for(1)
        stage.player.set_rate(1e9)
        stage.join()
    assert stage.heard == [0, 1]


@pytest.mark.parametrize('rate', [1e-11, 1e-300, 1e308])
def test_a_playback_does_not_end_whatever_its_rate(rate):
    """A wait of centuries, or a bag time without end, ended it by an OverflowError."""
    with Stage(Score(2, spacing=3600 * 10**9)) as stage:
        stage.wait_for(1)
        stage.player.set_rate(rate)
        time.sleep(0.01)
        assert stage.player.now() <= stage.player._timeline.end_ns
        stage.player.set_rate(1e9)
        stage.join()
    assert stage.heard == [0, 1]


@pytest.mark.parametrize('rate', [0.0, -1.0, float('nan'), float('inf')])
def test_a_rate_that_is_not_above_zero_is_refused(rate):
    player = Player(Score(2), lambda item: None)
    with pytest.raises(SemiparamError, match='rate must be a finite number above 0'):
        player.set_rate(rate)
    assert player.rate == 1.0


def test_an_unpaced_playback_has_no_rate():
    with pytest.raises(SemiparamError, match='no rate to set'):
        Player(Score(2), lambda item: None, rate=None).set_rate(2.0)


def readers():
    return sum(thread.name == 'read ahead' for thread in threading.enumerate())


def test_reading_ahead_changes_nothing_but_the_thread():
    score = Score(200)
    ahead = ReadAhead(score)
    assert list(ahead.play(score.start_ns)) == score.items and list(ahead.play(score.end_ns)) == score.items[-1:]
    assert list(ahead.play(score.end_ns + 1)) == [] and readers() == 0


def test_reading_ahead_stops_when_nobody_listens_any_more():
    items = ReadAhead(Endless()).play(0)
    assert next(items).time == 0 and readers() == 1
    items.close()
    assert readers() == 0


class Endless:
    """More than any queue holds."""

    start_ns, end_ns = 0, 10**18

    def play(self, from_ns):
        return (Item(k, '/t', b'') for k in itertools.count(from_ns))


def test_what_breaks_the_reading_is_raised_after_what_was_read():
    class Broken(Endless):
        def play(self, from_ns):
            yield Item(0, '/t', b'')
            raise SemiparamError('the bag is damaged here.')

    heard = []
    with pytest.raises(SemiparamError, match='damaged here'):
        Player(ReadAhead(Broken()), heard.append, rate=None).run()
    assert len(heard) == 1


class Hands:
    """A monotonic clock that a test moves."""

    def __init__(self):
        self.ns = 10**15

    def __call__(self):
        return self.ns


@given(st.lists(st.tuples(st.sampled_from(['wait', 'rate', 'pause', 'resume']), st.integers(1, 1000)), max_size=30))
def test_bag_time_is_the_integral_of_the_rate_over_the_time_it_runs(changes):
    hands = Hands()
    clock = PlayClock(0, monotonic=hands)
    expected, rate, paused = 0.0, 1.0, False
    for what, amount in changes:
        if what == 'wait':
            hands.ns += amount * MS
            expected += 0.0 if paused else amount * MS * rate
        elif what == 'rate':
            rate = amount / 100.0
            clock.set_rate(rate)
        else:
            paused = what == 'pause'
            clock.set_paused(paused)
        # Every change of rate rounds the bag time down to a whole nanosecond.
        assert abs(clock.now() - expected) <= len(changes) + 1e-9 * expected


def test_waiting_times_follow_the_rate():
    clock = PlayClock(1000, rate=4.0, monotonic=Hands())
    assert clock.seconds_until(1000 + 8 * 10**9) == pytest.approx(2.0)
    clock.jump(1000 + 4 * 10**9)
    assert clock.seconds_until(1000 + 8 * 10**9) == pytest.approx(1.0)
