// The slider between photograph and depth, and the choice of a view without a button.
"use strict";

function follow() {
  const slider = document.getElementById("depth-slider");
  const over = document.getElementById("depth-over");
  if (slider && over) over.style.opacity = String(slider.valueAsNumber / 100);
}

document.addEventListener("input", (event) => { if (event.target.id === "depth-slider") follow(); });
const CHOICE = ".view-choice select";
document.addEventListener("change", (event) => { if (event.target.matches(CHOICE)) event.target.form.requestSubmit(); });
follow(); // a browser that goes back keeps the slider where it was
// What was chosen before this script had come.
for (const choice of document.querySelectorAll(CHOICE)) {
  if (!choice.selectedOptions[0].defaultSelected) choice.form.requestSubmit();
}
