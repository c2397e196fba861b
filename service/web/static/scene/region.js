// Puts the region that was drawn in the frame of the 3D view into the form that records it.
"use strict";

(() => {
  const form = document.getElementById("region-form");
  const frame = document.querySelector(".scene-frame");
  if (!form || !frame) return;
  addEventListener("message", (event) => {
    if (event.source !== frame.contentWindow || !event.data || !("region" in event.data)) return;
    const { region } = event.data;
    form.elements.corners.value = region ? JSON.stringify(region.corners) : "";
    form.elements.along.value = region ? JSON.stringify(region.along) : "";
    form.hidden = !region;
    if (region) form.scrollIntoView({ block: "nearest" });
  });
})();
