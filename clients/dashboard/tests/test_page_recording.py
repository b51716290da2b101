"""Tests that a recording plays, pauses, plays fast, ends, and restarts."""

from teams import write_recording


def test_a_recording_plays_to_its_end(programs, open_page, tmp_path):
    file = tmp_path / "short.recording"
    programs.record(file, steps=500, publish_truth=True)
    look = open_page(programs.dashboard(recording=file))
    look.eventually(lambda: look.picture(".source") == "recording", "a recording")
    look.at("speed").select_option("0")
    look.eventually(lambda: look.picture(".player.speed") == 0, "as fast as possible")
    look.eventually(lambda: look.text("clock") == "ended", "its end")
    assert look.text("state") == "ended"
    assert look.picture(".kept.last") > look.picture(".kept.first")
    assert look.has("frame", "seen")
    look.page.keyboard.press("Home")
    look.eventually(lambda: look.picture(".shown.serial") == look.picture(".kept.first"), "first")
    # Plays so slowly that the recording does not end before the next press.
    look.page.evaluate("document.getElementById('speed').options[0].value = '0.001'")
    look.at("speed").select_option("0.001")
    look.eventually(lambda: look.picture(".player.speed") == 0.001, "slow")
    look.at("play").click()
    look.eventually(lambda: look.picture(".player.ended") is False, "again")
    look.eventually(lambda: look.text("state") == "playing", "it is said to play")
    look.at("play").click()
    look.eventually(lambda: look.text("state") == "paused", "it is said to rest")
    seconds = look.picture(".player.seconds")
    drawn = look.drawn()
    look.eventually(lambda: look.drawn() > drawn + 2, "pictures while stopped")
    assert look.picture(".player.seconds") == seconds


def test_a_recording_that_begins_with_nothing_can_be_played_faster(programs, open_page, tmp_path):
    file = tmp_path / "late.recording"
    write_recording(file, n_robots=1, n_steps=5, nanos=3600 * 10**9)
    look = open_page(programs.dashboard(recording=file))
    look.eventually(lambda: look.picture(".player.playing") is True, "it plays")
    assert look.picture(".shown") is None
    look.at("speed").select_option("0")
    look.eventually(lambda: look.text("clock") == "ended", "its end")
