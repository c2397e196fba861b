// A button that copies the text beside it; if the browser gives no access to the clipboard, it selects the text.
"use strict";

document.addEventListener("click", async (event) => {
  const button = event.target.closest("[data-copy]");
  if (!button) return;
  const text = document.getElementById(button.dataset.copy);
  const said = document.getElementById("copied");
  const words = text.textContent.trim();
  try {
    await navigator.clipboard.writeText(words); // none without TLS, but on this machine
    said.textContent = "Copied. It is gone from the clipboard when something else is copied.";
  } catch {
    const range = document.createRange();
    range.selectNodeContents(text);
    getSelection().removeAllRanges();
    getSelection().addRange(range);
    said.textContent = document.execCommand("copy") ? "Copied." : "It is selected: copy it with Ctrl-C.";
  }
});
