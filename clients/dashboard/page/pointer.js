// Where the pointer is. It may rest while what lies under it changes, so every drawing asks what is there now.

/** Follows the pointer; `changed()` is called when something else may lie under it. */
export function createPointer(changed) {
  let at = null;

  function follow(event) {
    if (!event.isPrimary) return;
    // It leaves when it goes out of the window, and as soon as a finger is lifted or scrolls.
    at = event.type === "pointerleave" ? null : { clientX: event.clientX, clientY: event.clientY };
    changed();
  }

  addEventListener("pointerdown", follow);
  addEventListener("pointermove", follow);
  document.documentElement.addEventListener("pointerleave", follow);
  addEventListener("scroll", () => at && changed(), { capture: true, passive: true });

  return {
    /** Which of `elements` it is on, and where: { element, clientX, clientY }; null if on none that is seen there. */
    on(elements) {
      const top = at && document.elementFromPoint(at.clientX, at.clientY);
      const element = top && elements.find((candidate) => candidate.contains(top));
      return element ? { element, ...at } : null;
    },
  };
}
