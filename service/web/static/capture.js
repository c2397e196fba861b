// The capture page: the nearest viewpoint of the plan to where a finger came down, and the camera's live view.
"use strict";

(() => {
  document.addEventListener("click", (event) => {
    const plan = event.target.closest("svg[data-plan]");
    if (!plan) return;
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(plan.getScreenCTM().inverse());
    let nearest = null;
    let best = 60; // units of the drawing: further away nothing is meant
    for (const group of plan.querySelectorAll("g[data-viewpoint]")) {
      const distance = Math.hypot(at.x - Number(group.dataset.x), at.y - Number(group.dataset.y));
      if (distance < best) [nearest, best] = [group, distance];
    }
    if (nearest) location.assign(`${plan.dataset.plan}&viewpoint=${encodeURIComponent(nearest.dataset.viewpoint)}`);
  });

  const panel = document.querySelector("[data-live]");
  if (!panel) return;
  const start = document.querySelector("[data-live-start]");
  const stop = document.querySelector("[data-live-stop]");
  const picture = panel.querySelector("img");
  const word = panel.querySelector(".live-word");
  const EVERY_MS = 500;
  let open = false;
  let shown = "";

  const say = (text) => {
    if (word.textContent !== text) word.textContent = text;
  };

  const next = async () => {
    if (!open) return;
    const began = performance.now();
    try {
      const response = await fetch(panel.dataset.live, { cache: "no-store" });
      if (response.status === 200) {
        const address = URL.createObjectURL(await response.blob());
        picture.src = address;
        picture.hidden = false;
        if (shown) URL.revokeObjectURL(shown);
        shown = address;
        say("Live");
      } else {
        picture.hidden = true;
        say(response.status === 204 ? "No frame yet: the camera is busy, or no capture runs." : "No frames: the run or the sign-in has ended.");
      }
    } catch {
      picture.hidden = true;
      say("Connection lost – the capture goes on.");
    }
    setTimeout(next, Math.max(100, EVERY_MS - (performance.now() - began)));
  };

  const set = (now) => {
    open = now;
    panel.hidden = !now;
    start.hidden = now;
    stop.hidden = !now;
    if (now) next();
    (now ? stop : start).focus();
  };
  start.addEventListener("click", () => set(true));
  stop.addEventListener("click", () => set(false));
  document.addEventListener("visibilitychange", () => {
    if (document.hidden && open) set(false);
  });
})();
