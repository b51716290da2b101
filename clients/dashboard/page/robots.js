// The robots of a team: one line of text for each, with its colour.

import { make, write } from "./elements.js";
import { robotColor } from "./palette.js";
import { isTeam, short } from "./words.js";

const DID = { flew: "flew", hovered: "hovered", late: "late", new: "not flown yet" };

export function createRobots(root) {
  let rows = [];

  function build(count) {
    rows = Array.from({ length: count }, (_, at) => {
      const row = { item: make("li"), mark: make("i", "robot", {}, String(at)), did: make("b"), rest: make("span") };
      row.mark.style.setProperty("--color", robotColor(at));
      row.item.append(row.mark, row.did, row.rest);
      return row;
    });
    root.replaceChildren(...rows.map((row) => row.item));
  }

  return {
    draw({ info, shown }, holders) {
      root.hidden = !info || !isTeam(shown);
      if (root.hidden) return;
      if (rows.length !== shown.robots.length) build(shown.robots.length);
      shown.robots.forEach(({ state, share }, at) => {
        const { mark, did, rest } = rows[at];
        mark.dataset.state = state;
        write(did, DID[state]);
        const holder = holders && (holders[at] == null ? "held by nobody" : `pid ${holders[at]}`);
        write(rest, [state === "flew" && `share ${short(share)}`, holder].filter(Boolean).join(" · "));
      });
    },
  };
}
