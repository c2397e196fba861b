// Forms that ask for a reason or a signature: reasons to choose from, PIN instead of password, a badge held to a reader.
"use strict";

(() => {
  // --- reasons: free text is required only if no preset reason is chosen ---

  const reasonsOf = (form) => form?.querySelector(".presets");
  function demandWords(form) {
    const words = form.querySelector("textarea[name=reason]");
    words.required = form.querySelector("input[name=preset]:checked")?.hasAttribute("data-own") || false;
  }
  function chooseOwnWords(form) {
    if (!form.querySelector("input[name=preset]:checked")) form.querySelector("[data-own]").checked = true;
    demandWords(form);
  }
  document.addEventListener("input", (event) => {
    const { form, name } = event.target;
    if (reasonsOf(form) && name === "reason") chooseOwnWords(form);
  });
  // What was typed before this script had come.
  for (const words of document.querySelectorAll("textarea[name=reason]")) {
    if (words.value && reasonsOf(words.form)) chooseOwnWords(words.form);
  }

  // --- password, PIN or badge ---

  const REMEMBERED = "orthocapture-signs-by";
  const LABELS = { password: "Password", pin: "PIN", badge: "Badge" };
  function show(secret, how) {
    const field = secret.querySelector("[name=password]");
    const label = secret.querySelector("[data-secret-label]");
    const whose = label.dataset.whose;
    label.textContent = whose ? LABELS[how] + whose : `Your ${how === "password" ? "password" : LABELS[how]}`;
    field.inputMode = how === "pin" ? "numeric" : "";
    field.autocomplete = how === "password" ? "current-password" : "off";
    field.value = "";
    const pad = secret.querySelector("[data-pin-pad]");
    if (pad) pad.hidden = how !== "pin";
    const hint = secret.querySelector("[data-badge-hint]");
    if (hint) hint.hidden = how === "pin"; // the digits take its place
  }
  document.addEventListener("change", (event) => {
    const { target } = event;
    if (target.name === "preset") demandWords(target.form);
    if (target.name !== "known_by") return;
    show(target.closest(".secret"), target.value);
    localStorage.setItem(REMEMBERED, target.value);
    target.closest(".secret").querySelector("[name=password]").focus();
  });
  // The way of signing that was used last on this screen comes first.
  function prefer() {
    for (const secret of document.querySelectorAll("dialog:not([open]) .secret")) {
      const wanted = secret.querySelector(`[name=known_by][value="${localStorage.getItem(REMEMBERED) || "password"}"]`);
      if (!wanted) continue;
      wanted.checked = true;
      show(secret, wanted.value);
    }
  }
  prefer();
  document.addEventListener("part-changed", prefer);

  // --- a badge: a reader types faster than any person, and ends with Enter ---

  const BETWEEN_MS = 60;
  const FEWEST = 6;
  let typed = "";
  let at = 0;
  let before = null; // the field into which it types, and what was in it
  document.addEventListener("keydown", (event) => {
    const secret = document.querySelector("dialog:modal [data-badge]");
    if (!secret || event.ctrlKey || event.metaKey || event.altKey) return;
    const soon = event.timeStamp - at < BETWEEN_MS;
    at = event.timeStamp;
    if (event.key === "Enter") {
      if (soon && typed.length >= FEWEST) {
        event.preventDefault();
        event.stopPropagation();
        sign(secret, typed);
      }
      typed = "";
      return;
    }
    if (!/^[0-9a-fA-F]$/.test(event.key)) { if (event.key !== "Shift") typed = ""; return; }
    if (!soon || !typed) {
      typed = "";
      const field = event.target.closest("input, textarea");
      before = field && "value" in field ? [field, field.value] : null;
    }
    typed += event.key;
  }, true);
  function sign(secret, badge) {
    if (before) before[0].value = before[1];
    const form = secret.closest("form");
    const way = secret.querySelector("[name=known_by][value=badge]");
    way.checked = true;
    show(secret, "badge");
    const field = secret.querySelector("[name=password]");
    field.value = badge;
    if (form.reportValidity()) form.requestSubmit(form.querySelector(".dialog-foot button"));
    else field.value = ""; // it says what is missing; then the badge once more
  }
})();
