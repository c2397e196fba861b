// Elements that are still being computed ([data-pending] with an id) are fetched again until they are complete.
"use strict";

const WAIT_MS = 700;
let pressed = false; // what is being pressed must not be replaced under the finger
for (const [kind, now] of [["pointerdown", true], ["pointerup", false], ["pointercancel", false]]) {
  addEventListener(kind, () => { pressed = now; }, { capture: true });
}

async function refill() {
  const pending = [...document.querySelectorAll("[data-pending][id]")];
  if (!pending.length) return;
  let again = true;
  try {
    const answer = await fetch(location.href, { headers: { Accept: "text/html" } });
    if (answer.ok) {
      const page = new DOMParser().parseFromString(await answer.text(), "text/html");
      for (const place of pressed ? [] : pending) {
        const fresh = page.getElementById(place.id);
        if (!fresh) continue;
        const focused = place.contains(document.activeElement);
        place.replaceWith(document.adoptNode(fresh));
        if (focused) fresh.querySelector("a, button, summary")?.focus();
      }
      again = document.querySelector("[data-pending][id]") !== null;
      if (!again) {
        const news = document.getElementById("news");
        if (news) news.textContent = "The page is complete now.";
      }
    }
  } catch {
    // The connection is lost; the next attempt follows.
  }
  if (again) setTimeout(refill, WAIT_MS);
}

setTimeout(refill, WAIT_MS);
