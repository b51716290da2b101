"""Tests rare pictures: damaged pictures, and pictures that report losses."""

import json
from collections.abc import Callable


def told_again(message: bytes, change: Callable[[dict], None]) -> bytes:
    end = 4 + int.from_bytes(message[:4], "little")
    words = json.loads(message[4:end])
    change(words)
    text = json.dumps(words).encode()
    text += b" " * (-(4 + len(text)) % 8)
    return len(text).to_bytes(4, "little") + text + message[end:]


def test_damaged_pictures_are_told_and_do_not_flood_the_console(watched):
    look = watched.look
    look.allowed.append("expected 4 bytes")
    damaged, told = [], []

    def damage(message: bytes) -> bytes:
        if told and len(damaged) >= 10:
            return message
        damaged.append(message)
        return message[:3]

    look.alter(damage)
    look.eventually(lambda: look.text("state") == "unreadable", "told")
    assert "cannot read" in look.text("note")
    told.append(True)
    look.eventually(lambda: look.text("state") == "serving", "pictures again")
    assert not look.at("note").is_visible()
    assert look.heard("expected 4 bytes") == 1


def test_what_is_lost_or_not_known_is_told(watched):
    look = watched.look
    watched.agent.interrupt()

    def change(words: dict) -> None:
        words["lost"] = {"frames": 0, "truth": 2, "agent": 1}
        if words["shown"]:
            words["shown"] |= {"seen_since": 12, "log_loss": None}
        if words["agent"]:
            words["agent"]["states"] = ["this", "that", "other"]
        # The agent soon has seen every cell, so the test sends its last path's frame as `seen`.
        names = {"series_log_loss": "unscored", "seen": "all", "frame": "seen"}
        for array in words["arrays"]:
            array["name"] = names.get(array["name"], array["name"])

    look.alter(lambda message: told_again(message, change))
    look.eventually(lambda: look.has("belief", "seen"), "a belief is shown")
    look.eventually(lambda: look.picture(".agent.is_live") is False, "the last picture")
    assert look.text("lost") == "0"
    assert look.text("lost-others") == "· truth 2 · beliefs 1"
    assert look.page.get_by_text("its states are not the model's").is_visible()
    assert look.page.get_by_text("since k = 12", exact=True).is_visible()
    assert "since k = 12" in look.at("panel-seen").get_attribute("aria-label")
    width = look.picture(".info.width")
    row, col = divmod(list(look.array("seen")).index(255), width)
    box = look.at("panel-seen").bounding_box()
    size = box["width"] / width
    look.at("panel-seen").hover(position={"x": (col + 0.5) * size, "y": (row + 0.5) * size})
    look.eventually(
        lambda: look.page.get_by_text("not since k = 12").is_visible(), "a cell not seen since"
    )
