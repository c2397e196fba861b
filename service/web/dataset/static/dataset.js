// The slider between photograph and depth, and the choice of a view without a button.
"use strict";

function follow() {
  const slider = document.getElementById("depth-slider");
  const over = document.getElementById("depth-over");
  if (slider && over) over.style.opacity = String(slider.valueAsNumber / 100);
}

document.addEventListener("input", (event) => { if (event.target.id === "depth-slider") follow(); });
document.addEventListener("change", (event) => {
  if (event.target.matches(".view-choice select")) event.target.form.requestSubmit();
});
follow(); // a browser that goes back keeps the slider where it was
