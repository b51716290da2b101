"""Tests that nothing is clipped and no elements overlap, at all common window sizes."""

import pytest

from models import write_model
from teams import write_recording

SIZES = [(360, 740), (768, 1024), (1024, 768), (1056, 640), (1280, 720), (1920, 1080), (2560, 1440)]

# Records the position of each text drawn on a canvas since the last clear, in canvas pixels.
RECORD_TEXTS = """(() => {
  const { prototype } = CanvasRenderingContext2D;
  const { clearRect, fillText } = prototype;
  prototype.clearRect = function (...box) {
    this.canvas.texts = [];
    clearRect.apply(this, box);
  };
  prototype.fillText = function (text, x, y) {
    const size = this.measureText(text);
    const { a, d, e, f } = this.getTransform();
    this.canvas.texts.push({
      name: text,
      left: a * (x - size.actualBoundingBoxLeft) + e,
      right: a * (x + size.actualBoundingBoxRight) + e,
      top: d * (y - size.actualBoundingBoxAscent) + f,
      bottom: d * (y + size.actualBoundingBoxDescent) + f,
    });
    fillText.call(this, text, x, y);
  };
})()"""

# Returns the page's current problems as sentences.
PROBLEMS = """() => {
  const problems = [];
  const all = (selector) => [...document.querySelectorAll(selector)]
    .filter((element) => element.getClientRects().length > 0);
  const nameOf = (element) => element.dataset.testid ?? (element.id || element.className)
    + (element.dataset.panel ?? "");
  const within = (inner, outer, by) => inner.left >= outer.left - by && inner.top >= outer.top - by
    && inner.right <= outer.right + by && inner.bottom <= outer.bottom + by;
  const meet = (one, other, by) => one.left < other.right - by && other.left < one.right - by
    && one.top < other.bottom - by && other.top < one.bottom - by;
  const pairs = (boxes, by, where) => boxes.forEach((one, i) => boxes.slice(i + 1)
    .filter((other) => meet(one, other, by))
    .forEach((other) => problems.push(`${where}: ${one.name} and ${other.name} overlap`)));

  for (const canvas of all(".plot canvas")) {
    const frame = { left: 0, top: 0, right: canvas.width, bottom: canvas.height };
    for (const text of canvas.texts) {
      if (!within(text, frame, 0.5)) problems.push(`${nameOf(canvas)}: ${text.name} is clipped`);
    }
    pairs(canvas.texts, 0, nameOf(canvas));
  }

  const around = all(".bar, .facts, .robots, .stage").map((element) => {
    const { left, top, right, bottom } = element.getBoundingClientRect();
    return { name: nameOf(element), left, top, right, bottom };
  });
  pairs(around, 1, "page");
  const parts = all(".panel, .inspector, .no-belief, .chart, .legend, .ramps").map((element) => {
    const { left, top, right, bottom } = element.getBoundingClientRect();
    const filled = Math.max(bottom, top + element.scrollHeight);
    return { name: nameOf(element), left, top, right, bottom: filled };
  });
  pairs(parts, 1, "stage");
  const isFixed = getComputedStyle(document.querySelector(".transport")).position === "static";
  if (isFixed) {
    const stage = document.querySelector(".stage").getBoundingClientRect();
    const scrolls = getComputedStyle(document.querySelector(".field")).overflowY === "auto";
    const out = scrolls ? [] : parts.filter((part) => !within(part, stage, 1));
    out.forEach(({ name }) => problems.push(`${name} is outside the stage`));
    if (document.documentElement.scrollHeight > innerHeight) problems.push("the page scrolls");
  }
  if (document.documentElement.scrollWidth > innerWidth) problems.push("the page is too wide");

  // Texts within all that clips them; where one ends in an ellipsis its start is seen.
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement;
    if (!node.data.trim() || parent.closest(".unseen, option, noscript, script")) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects()) {
      for (let outer = parent; outer; outer = outer.parentElement) {
        const style = getComputedStyle(outer);
        if (style.textOverflow === "ellipsis") break;
        const frame = outer.getBoundingClientRect();
        const clips = outer === document.body || style.overflowX !== "visible";
        if (clips && (box.left < frame.left - 1 || box.right > frame.right + 1)) {
          problems.push(`${nameOf(outer)} clips ${node.data}`);
        }
      }
    }
  }
  return problems;
}"""


def check(look) -> None:
    """Checks for problems at each window size. The page's data must not change meanwhile."""
    for width, height in SIZES:
        look.page.set_viewport_size({"width": width, "height": height})
        # The recorded texts of a canvas are out of date until it is redrawn.
        look.eventually(lambda w=width: look.page.evaluate("innerWidth") == w, "the window's size")
        look.wait_for_pictures()
        assert look.page.evaluate(PROBLEMS) == [], f"at {width} x {height}"


def begin(look) -> None:
    """Reloads the page, and starts to record the texts that it draws."""
    look.page.add_init_script(RECORD_TEXTS)
    look.page.reload()
    look.eventually(lambda: look.has("frame"), "a world")


def test_before_and_after_an_agent_acts(programs, open_page):
    # About two thousand cells burn, so that the number has a thousands separator.
    server = programs.server(height=64, width=64, moves=64, burn_in=12000, publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    begin(look)
    look.eventually(lambda: look.text("holder") == "nobody", "the server's facts")
    check(look)
    assert programs.agent(server.instance, steps=1500).wait() == 0
    look.eventually(lambda: look.picture(".agent.is_live") is False, "the last belief")
    look.eventually(lambda: look.text("holder") == "nobody", "the agent is gone")
    check(look)


@pytest.mark.parametrize("n_robots", [3, 64])
def test_with_a_recording_of_a_team(programs, open_page, tmp_path, n_robots):
    file = tmp_path / "with-a-rather-long-name.recording"
    write_recording(file, n_robots, n_steps=5)
    look = open_page(programs.dashboard(recording=file))
    begin(look)
    look.eventually(lambda: look.text("clock") == "ended", "its end")
    assert look.at("robots").locator("li").count() == n_robots
    check(look)


def test_with_many_states(programs, open_page, tmp_path):
    model = write_model(tmp_path / "model.toml", 9, 9)
    server = programs.server(model=model, publish_truth=True)
    look = open_page(programs.dashboard(server.instance))
    begin(look)
    assert programs.agent(server.instance, model=model, steps=40).wait() == 0
    look.eventually(lambda: look.picture(".agent.is_live") is False, "the last belief")
    look.eventually(lambda: look.text("holder") == "nobody", "the agent is gone")
    check(look)
