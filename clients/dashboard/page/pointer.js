// The pointer's position. The element under a resting pointer may change, so it is looked up anew for every drawing.

/** Follows the pointer. Calls `changed()` when the element under the pointer may have changed. */
export function createPointer(changed) {
  let at = null;

  function follow(event) {
    if (!event.isPrimary) return;
    // The pointer leaves when it exits the window, or when a finger is lifted or scrolls.
    at = event.type === "pointerleave" ? null : { clientX: event.clientX, clientY: event.clientY };
    changed();
  }

  addEventListener("pointerdown", follow);
  addEventListener("pointermove", follow);
  document.documentElement.addEventListener("pointerleave", follow);
  addEventListener("scroll", () => at && changed(), { capture: true, passive: true });

  return {
    /** Returns the visible element of `elements` under the pointer: { element, clientX, clientY }, or null. */
    on(elements) {
      const top = at && document.elementFromPoint(at.clientX, at.clientY);
      const element = top && elements.find((candidate) => candidate.contains(top));
      return element ? { element, ...at } : null;
    },
  };
}
