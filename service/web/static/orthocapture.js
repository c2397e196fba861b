"use strict";
/* Keeps a page up to date, lets dangerous buttons be held, sends forms without leaving the page. It never acts by
 * itself: every POST follows a person's press. Without it every form works as plain HTML. */

(() => {
  const LOST_AFTER_MS = 3500;
  const POLL_MS = 2000;
  const PART_MS = 8000; // for a part to arrive
  const RETRY_MS = 1000;
  const ANSWER_MS = 60000; // for what a person asked for to be done
  const SHORT_MS = 4000; // how long it is said that a button was let go too soon
  const body = document.body;
  const by = (id) => document.getElementById(id);
  let offline = false;

  // --- news for screen readers --------------------------------------------------------------------------------

  const told = { news: collected("news"), alarm: "" };
  function collected(kind) {
    return [...document.querySelectorAll(`[data-${kind}]`)].map((e) => e.dataset[kind].trim()).filter(Boolean).join(" ");
  }
  function announce() {
    for (const kind of ["news", "alarm"]) {
      const text = collected(kind);
      if (text !== told[kind]) by(kind).textContent = text;
      told[kind] = text;
    }
  }

  // --- parts: fetched again after a change -------------------------------------------------------------------------

  let fetching = false;
  let again = false;
  let outdatedSince = 0; // news has come that could not be fetched; 0: the page is up to date
  let retry = 0;
  async function refresh() {
    if (fetching) { again = true; return; }
    fetching = true;
    clearTimeout(retry);
    do {
      again = false;
      try {
        // Fetched together and shown at once, so that a button never stands beside the text of another step.
        const news = await Promise.all([...gathered()].map(([address, parts]) => fetchParts(address, parts)));
        for (const [part, fresh] of news.flat()) if (part.isConnected) showPart(part, fresh);
        outdatedSince = 0;
      } catch { outdatedSince ||= Date.now(); }
    } while (again);
    fetching = false;
    // A run that waits for a person sends no further news, so this one must not be missed.
    if (outdatedSince) retry = setTimeout(refresh, RETRY_MS);
    announce();
    document.dispatchEvent(new CustomEvent("page-changed"));
    followLock();
    startAtHead();
    if (offline) setControls(true);
  }

  // When a step begins or stops, screen readers start at its title.
  const headOf = () => document.querySelector("[data-head]")?.dataset.head;
  let head = headOf();
  function startAtHead() {
    const now = headOf();
    if (now === head || document.querySelector("dialog[open]")) return;
    head = now;
    window.scrollTo({ top: 0, behavior: "instant" });
    document.querySelector("[data-head] h1")?.focus({ preventScroll: true });
  }
  function gathered() { // the parts of one address are asked for together and tell of one moment
    const groups = new Map();
    for (const part of document.querySelectorAll("[data-part]")) {
      const [, folder, name, query] = part.dataset.part.match(/^(.*\/)(\w+)(\?.*)?$/);
      const key = `${folder}*${query || ""}`;
      groups.set(key, (groups.get(key) || new Map()).set(name, part));
    }
    return groups;
  }
  async function fetchParts(address, parts) {
    const names = [...parts.keys()].join(",");
    const answer = await fetch(address.replace("*", names), { headers: { Accept: "text/html" }, cache: "no-store", signal: AbortSignal.timeout(PART_MS) });
    if (answer.redirected && new URL(answer.url).pathname === "/sign-in") { location.reload(); return []; }
    if (!answer.ok) throw new Error(answer.statusText);
    const fresh = document.createElement("template");
    fresh.innerHTML = await answer.text();
    return [...fresh.content.children].map((each) => [parts.get(each.dataset.part), each]);
  }
  function showPart(part, fresh) {
    holdInstead(fresh.content);
    merging.mergeChildren(part, fresh.content);
    part.dispatchEvent(new CustomEvent("part-changed", { bubbles: true }));
  }

  // --- verdicts: they stay until a person has decided something, or has pressed Seen on this screen -----------------

  const seenKey = `orthocapture-seen-${body.dataset.run}`;
  function hideSeen() {
    for (const judged of document.querySelectorAll("[data-judged]")) judged.hidden = Number(judged.dataset.judged) <= Number(localStorage.getItem(seenKey));
  }
  document.addEventListener("click", (event) => {
    const judged = event.target instanceof Element && event.target.closest("[data-seen]")?.closest("[data-judged]");
    if (!judged) return;
    localStorage.setItem(seenKey, judged.dataset.judged);
    hideSeen();
  });
  document.addEventListener("part-changed", hideSeen);
  hideSeen();

  // --- connection ------------------------------------------------------------------------------------------------

  let stream = null;
  let heardAt = Date.now();
  let known = "";
  let opening = 0;
  let replaced = false;
  function connect() {
    opening = Date.now();
    replaced = false;
    stream?.close();
    stream = new EventSource(body.dataset.stream);
    const heard = () => { heardAt = Date.now(); if (offline && !outdatedSince) backOnline(); };
    stream.addEventListener("changed", (event) => {
      const fresh = event.data !== known;
      known = event.data;
      const wasOffline = offline;
      heard();
      if (fresh && !wasOffline) refresh();
    });
    stream.addEventListener("beat", heard);
    stream.addEventListener("signed_out", () => location.reload());
    // This sign-in has opened newer pages, and streams are limited: a hidden page waits until somebody looks at it.
    stream.addEventListener("replaced", () => { stream.close(); replaced = true; });
  }
  function watch() {
    if (replaced && document.hidden) { if (!offline) goOffline(); return; }
    const now = Date.now();
    const lost = now - heardAt > LOST_AFTER_MS || (outdatedSince && now - outdatedSince > LOST_AFTER_MS);
    if (lost && !offline) goOffline();
    if (now - heardAt > 1500 && now - opening > 2500) connect();
  }

  // Pages without a stream ask every two seconds for the robots' states, and whether the service answers.
  const robots = by("robots");
  let answeredAt = Date.now();
  let asking = false;
  async function poll() {
    if (asking || document.hidden) return;
    asking = true;
    try {
      const answer = await fetch(robots.dataset.poll, { headers: { Accept: "text/html" }, cache: "no-store", signal: AbortSignal.timeout(POLL_MS) });
      if (answer.redirected && new URL(answer.url).pathname === "/sign-in") { location.reload(); return; }
      if (!answer.ok) throw new Error(answer.statusText);
      const fresh = document.createElement("template");
      fresh.innerHTML = await answer.text();
      answeredAt = Date.now();
      merging.mergeChildren(robots, fresh.content);
      announce();
      document.dispatchEvent(new CustomEvent("page-changed"));
      if (offline && !body.dataset.stream) backOnline();
    } catch {
      if (Date.now() - answeredAt > LOST_AFTER_MS) robotsUnknown();
    }
    asking = false;
  }
  function robotsUnknown() {
    if (!body.dataset.stream && !offline) goOffline();
    // The page of a run that lost its connection already says so for its own robot.
    if (!body.dataset.stream || robots.childElementCount) merging.mergeChildren(robots, by("robots-lost").content);
  }
  document.addEventListener("visibilitychange", () => {
    if (robots && !document.hidden) { answeredAt = Date.now(); poll(); }
  });

  function goOffline() {
    offline = true;
    cancelHold();
    body.classList.add("offline");
    const told = [...document.querySelectorAll("[data-attention]")];
    const ended = Boolean(body.dataset.run) && told.length > 0 && told.every((run) => run.dataset.attention === "ended");
    by("connection-lost").querySelector("[data-goes-on]").hidden = ended;
    by("connection-lost").hidden = false;
    setControls(true);
  }
  function backOnline() {
    offline = false;
    body.classList.remove("offline");
    by("connection-lost").hidden = true;
    setControls(false);
    refresh();
  }
  function setControls(off) {
    const which = off ? "button:not(:disabled), input:not(:disabled), select:not(:disabled), textarea:not(:disabled)" : "[data-offline]";
    for (const control of document.querySelectorAll(`:is(main, aside, dialog, .in-sight) :is(${which})`)) {
      control.disabled = off;
      control.toggleAttribute("data-offline", off);
    }
  }

  // --- hold to confirm -------------------------------------------------------------------------------------------

  // Until this script has come, and where it never does, a box to tick stands before what a mere tap would send.
  function holdInstead(where) {
    for (const box of where.querySelectorAll("[data-instead-of-hold]")) box.remove();
  }
  holdInstead(document);
  let held = null; // {button, from, need, frame, key}
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  function startHold(button, key) {
    if (offline || held || button.disabled || button.form?.dataset.busy) return;
    held = { button, from: performance.now(), need: Number(button.dataset.hold), key, frame: 0 };
    button.classList.add("held");
    delete button.dataset.short;
    by("news").textContent = "Keep holding.";
    turn();
  }
  function turn() {
    if (!held) return;
    const { button, from, need } = held;
    const share = Math.min((performance.now() - from) / need, 1);
    if (!button.isConnected || button.disabled) { cancelHold(); return; }
    button.style.setProperty("--held", String(still.matches ? Math.floor(share * 3) * 100 / 3 : share * 100));
    if (share < 1) { held.frame = requestAnimationFrame(turn); return; }
    endHold();
    button.dataset.done = "yes";
    button.form.requestSubmit(button);
    delete button.dataset.done;
  }
  function cancelHold() {
    if (!held) return;
    const { button } = held;
    endHold();
    by("news").textContent = button.isConnected ? "Let go too soon: nothing was sent." : "The page has changed: nothing was sent.";
    button.dataset.short = "yes";
    setTimeout(() => { delete button.dataset.short; }, SHORT_MS);
  }
  function endHold() {
    cancelAnimationFrame(held.frame);
    held.button.classList.remove("held");
    held.button.style.removeProperty("--held");
    held = null;
  }
  const holdable = (event) => (event.target instanceof Element ? event.target.closest("button[data-hold]") : null);
  document.addEventListener("pointerdown", (event) => {
    const button = holdable(event);
    if (!button || event.button !== 0 || !event.isPrimary) { cancelHold(); return; }
    if (button.hasPointerCapture(event.pointerId)) button.releasePointerCapture(event.pointerId);
    startHold(button, null);
  });
  for (const kind of ["pointerup", "pointercancel"]) document.addEventListener(kind, () => { if (held?.key === null) cancelHold(); });
  document.addEventListener("pointermove", (event) => {
    if (held?.key === null && !held.button.contains(document.elementFromPoint(event.clientX, event.clientY))) cancelHold();
  });
  document.addEventListener("keydown", (event) => {
    const button = holdable(event);
    if (!button || !["Enter", " "].includes(event.key)) { if (held) cancelHold(); return; }
    event.preventDefault();
    if (!event.repeat) startHold(button, event.key);
  });
  document.addEventListener("keyup", (event) => { if (held && held.key === event.key) cancelHold(); });
  document.addEventListener("focusout", (event) => { if (held?.button === event.target) cancelHold(); });
  document.addEventListener("contextmenu", (event) => { if (holdable(event)) event.preventDefault(); });
  document.addEventListener("visibilitychange", cancelHold);
  window.addEventListener("blur", cancelHold);

  // --- forms -------------------------------------------------------------------------------------------------------

  document.addEventListener("submit", (event) => {
    const form = event.target;
    const button = event.submitter;
    if (button?.matches("[data-hold]") && !button.dataset.done) { event.preventDefault(); return; }
    if (form.method !== "post" || form.hasAttribute("data-plain")) return;
    event.preventDefault();
    if (form.dataset.busy || (offline && !form.matches(".theme-form"))) return;
    send(form, button);
  });
  async function send(form, button) {
    const entered = new FormData(form, button);
    const fields = form.enctype === "multipart/form-data" ? entered : new URLSearchParams(entered); // with a file, or none
    const action = new URL(button?.getAttribute("formaction") || form.getAttribute("action") || location.href, location.href);
    if (action.pathname === "/theme") document.documentElement.dataset.theme = fields.get("theme");
    const ended = showSent(form, button);
    say(form, "");
    try {
      const answer = await fetch(action, { method: "POST", body: fields, headers: { Accept: "application/json", "X-CSRF-Token": body.dataset.csrf || "" }, signal: AbortSignal.timeout(ANSWER_MS) });
      ended();
      if (answer.ok) await succeed(form, action, answer);
      else await fail(form, answer);
    } catch {
      ended();
      say(form, "This did not reach the service. Whether it had an effect shows when the connection is back.");
      refresh();
    }
    delete form.dataset.busy;
  }
  // The form is sent once: it says so, stays as it was until the answer comes, and can be pressed again once that is shown.
  function showSent(form, button) {
    const sent = document.createElement("span");
    form.dataset.busy = "sent";
    button?.setAttribute("aria-disabled", "true");
    sent.className = "sent";
    sent.textContent = "Sent…";
    if (!form.hasAttribute("data-quiet")) button?.append(sent);
    by("news").textContent = "Sent…";
    return () => {
      form.dataset.busy = "answered";
      button?.removeAttribute("aria-disabled");
      sent.remove();
    };
  }
  async function succeed(form, action, answer) {
    if (action.pathname === "/theme") return;
    if (action.pathname === "/lock") { showLock(true); return; }
    if (action.pathname === "/unlock") { form.reset(); showLock(false); await refresh(); return; }
    if (form.hasAttribute("data-stay")) { await refresh(); return; } // pausing: wherever it was asked for
    const target = new URL(answer.url);
    const here = document.querySelector("[data-part]") && target.pathname === location.pathname;
    form.closest("dialog")?.close();
    form.closest("details[open]")?.removeAttribute("open");
    if (!here || !answer.redirected) { location.assign(answer.redirected ? answer.url : location.href); return; }
    if (location.search) history.replaceState(null, "", location.pathname);
    form.reset();
    await refresh();
  }
  async function fail(form, answer) {
    let problem = {};
    try { problem = await answer.json(); } catch { /* no words came with it */ }
    if (answer.status === 401 && !form.closest("dialog") && !form.querySelector("[type=password]")) { location.reload(); return; }
    if (answer.status === 423) { showLock(true); return; }
    const words = [problem.what || "The service could not do this", problem.remedy, problem.safe].filter(Boolean);
    say(form, words.map((line) => line[0].toUpperCase() + line.slice(1).replace(/[.]?$/, ".")).join(" "));
    for (const secret of form.querySelectorAll("[type=password]")) { secret.value = ""; secret.setAttribute("aria-invalid", "true"); secret.focus(); }
    refresh();
  }
  function say(form, words) {
    const own = form.isConnected && form.querySelector(".form-problem");
    const place = own || by("problem");
    place.textContent = words;
    place.hidden = !words;
    if (words && !own) {
      by("alarm").textContent = words;
      place.scrollIntoView({ block: "nearest" });
    }
  }

  // --- dialogs and lock --------------------------------------------------------------------------------------------

  document.addEventListener("click", (event) => {
    const at = event.target instanceof Element ? event.target : null;
    const opener = at?.closest("[data-dialog]");
    if (opener && by(opener.dataset.dialog)) {
      event.preventDefault();
      if (!offline) {
        const chosen = opener.dataset.choose && by(opener.dataset.dialog).querySelector(`input[name=step][value="${opener.dataset.choose}"][type=radio]`);
        if (chosen) chosen.checked = true;
        by(opener.dataset.dialog).showModal();
      }
      return;
    }
    if (at?.closest("[data-close]")) {
      event.preventDefault();
      at.closest("dialog").close();
      return;
    }
    const digit = at?.closest("[data-digit]")?.dataset.digit;
    if (digit) {
      const pin = at.closest("form").querySelector("[name=pin], [name=password]");
      pin.value = digit === "clear" ? "" : pin.value + digit;
    }
  });
  document.addEventListener("keydown", (event) => { // links that act as buttons answer to the space bar as well
    if (event.key === " " && event.target.matches?.('a[role="button"]')) { event.preventDefault(); event.target.click(); }
  });
  document.addEventListener("close", (event) => { if (event.target.id !== "lock-screen") refresh(); }, true);
  // What happened while a form was open was held back from it.
  document.addEventListener("toggle", (event) => { if (event.target.matches("[data-part] details:has(form):not([open])")) refresh(); }, true);
  function showLock(locked) {
    const dialog = by("lock-screen");
    if (!dialog) return;
    body.classList.toggle("locked-behind", locked);
    if (!locked) { dialog.close(); return; }
    cancelHold();
    if (dialog.matches(":modal")) return;
    if (dialog.open) dialog.close(); // as it came with the page, before the script
    dialog.showModal();
    dialog.querySelector("[name=pin]").focus();
  }
  by("lock-screen")?.addEventListener("cancel", (event) => event.preventDefault());
  function followLock() {
    const screen = document.querySelector("[data-part] [data-screen]");
    if (screen) showLock(screen.dataset.screen === "locked");
  }

  for (const dialog of document.querySelectorAll("dialog[open]:not(#lock-screen)")) { dialog.close(); dialog.showModal(); }
  if (body.hasAttribute("data-locked")) showLock(true);
  if (body.dataset.stream) {
    told.alarm = "";
    announce();
    connect();
    setInterval(watch, 500);
  }
  if (robots) setInterval(poll, POLL_MS);
})();
