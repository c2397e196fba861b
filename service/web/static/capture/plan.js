// The plan of the viewpoints: zoomed by buttons, wheel and two fingers; viewpoints closer together than a fingertip are
// chosen from a list.
"use strict";

(() => {
  const FINGER_PX = 24; // half of what a fingertip covers
  const FAR_PX = 60; // further away from every viewpoint nothing is meant
  const LARGEST = 16;
  const STEP = 1.6; // of a button
  // By step and station: zoom, and the middle of the visible part in units of the drawing. It is kept from page to page,
  // since each viewpoint has its own.
  const KEY = `orthocapture-plan ${location.pathname}`;
  const looks = new Map(JSON.parse(sessionStorage.getItem(KEY) || "[]"));
  const planOf = (event) => (event.target instanceof Element ? event.target.closest("svg[data-plan]") : null);
  const nameOf = (plan) => `${plan.dataset.plan} ${plan.closest("[data-station]").dataset.station}`;
  const sizeOf = (plan) => [Number(plan.getAttribute("data-width")), Number(plan.getAttribute("data-height"))];

  function look(plan) {
    const [width, height] = sizeOf(plan);
    return looks.get(nameOf(plan)) || { larger: 1, x: width / 2, y: height / 2 };
  }
  function show(plan) {
    const { larger, x, y } = look(plan);
    const [width, height] = sizeOf(plan);
    const [w, h] = [width / larger, height / larger];
    plan.setAttribute("viewBox", `${x - w / 2} ${y - h / 2} ${w} ${h}`);
    plan.classList.toggle("larger", larger > 1);
    // The symbols keep their size on the screen, so that overlapping ones separate.
    for (const group of plan.querySelectorAll("g[data-viewpoint]")) {
      const [at, down] = [group.dataset.x, group.dataset.y];
      if (larger > 1) group.setAttribute("transform", `translate(${at} ${down}) scale(${1 / larger}) translate(${-at} ${-down})`);
      else group.removeAttribute("transform");
    }
    for (const text of plan.querySelectorAll(".plan-word")) {
      const [at, down] = [text.getAttribute("x"), text.getAttribute("y")];
      text.setAttribute("transform", `translate(${at} ${down}) scale(${1 / larger}) translate(${-at} ${-down})`);
    }
    const box = plan.closest("[data-station]");
    box.querySelector("[data-zoom-word]").textContent = `${larger.toFixed(1)}×`;
    box.querySelector("[data-zoom=in]").disabled = larger >= LARGEST;
    for (const button of box.querySelectorAll("[data-zoom=out], [data-zoom=whole]")) button.disabled = larger <= 1;
  }
  function set(plan, larger, x, y) {
    const [width, height] = sizeOf(plan);
    const now = Math.min(Math.max(larger, 1), LARGEST);
    // With a larger zoom the middle may come nearer to the edge, so that the edge can be seen as well.
    const within = (at, size) => Math.min(Math.max(at, size / now / now / 2), size - size / now / now / 2);
    looks.set(nameOf(plan), { larger: now, x: within(x, width), y: within(y, height) });
    sessionStorage.setItem(KEY, JSON.stringify([...looks]));
    show(plan);
  }
  function pointOf(plan, clientX, clientY) {
    return new DOMPoint(clientX, clientY).matrixTransform(plan.getScreenCTM().inverse());
  }
  /** Zooms by a factor about a point of the screen. */
  function zoom(plan, factor, clientX, clientY) {
    const now = look(plan);
    const larger = Math.min(Math.max(now.larger * factor, 1), LARGEST);
    const at = pointOf(plan, clientX, clientY);
    const share = now.larger / larger;
    set(plan, larger, at.x + (now.x - at.x) * share, at.y + (now.y - at.y) * share);
  }
  function move(plan, dxPx, dyPx) {
    const now = look(plan);
    const scale = plan.getScreenCTM().a;
    set(plan, now.larger, now.x - dxPx / scale, now.y - dyPx / scale);
  }

  /** Where a zoom by button goes: to the viewpoint that is shown, the next one, or the one nearest to the middle. */
  function wanted(plan) {
    const [width, height] = sizeOf(plan);
    const from = ({ x, y }) => Math.hypot(x - width / 2, y - height / 2);
    const all = [...plan.querySelectorAll("g[data-viewpoint]")];
    const chosen = all.find((g) => g.querySelector(".plan-chosen")) || all.find((g) => g.querySelector(".sym-next"));
    const places = (chosen ? [chosen] : all).map((g) => ({ x: Number(g.dataset.x), y: Number(g.dataset.y) }));
    return places.sort((a, b) => from(a) - from(b))[0];
  }
  document.addEventListener("click", (event) => {
    const button = event.target.closest("[data-zoom]");
    if (!button) return;
    const plan = button.closest("[data-station]").querySelector("svg[data-plan]");
    const now = look(plan);
    const first = now.larger === 1 ? wanted(plan) || now : now;
    if (button.dataset.zoom === "in") set(plan, now.larger * STEP, first.x, first.y);
    else set(plan, button.dataset.zoom === "out" ? now.larger / STEP : 1, now.x, now.y);
  });
  document.addEventListener("wheel", (event) => {
    const plan = planOf(event);
    if (!plan || (event.deltaY > 0 && look(plan).larger === 1)) return; // the page scrolls on
    event.preventDefault();
    zoom(plan, Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.004), event.clientX, event.clientY);
  }, { passive: false });

  // Two fingers zoom; one finger moves the enlarged plan.
  let fingers = null; // {plan, apart, x, y} of the last event
  const middle = (touches) => ({
    x: [...touches].reduce((sum, t) => sum + t.clientX, 0) / touches.length,
    y: [...touches].reduce((sum, t) => sum + t.clientY, 0) / touches.length,
    apart: touches.length < 2 ? 0 : Math.hypot(touches[0].clientX - touches[1].clientX, touches[0].clientY - touches[1].clientY),
  });
  let moved = 0; // px since a finger or the button of the mouse came down: beyond a few it is no choice
  document.addEventListener("touchstart", (event) => {
    const plan = planOf(event);
    if (event.touches.length === 1) moved = 0;
    fingers = plan ? { plan, ...middle(event.touches) } : null;
    if (plan && event.touches.length > 1) event.preventDefault();
  }, { passive: false });
  document.addEventListener("touchmove", (event) => {
    if (!fingers?.plan.isConnected) return;
    const { plan } = fingers;
    const now = middle(event.touches);
    moved += Math.hypot(now.x - fingers.x, now.y - fingers.y);
    if (event.touches.length > 1 && fingers.apart && now.apart) {
      event.preventDefault();
      moved += 100;
      zoom(plan, now.apart / fingers.apart, now.x, now.y);
      move(plan, now.x - fingers.x, now.y - fingers.y);
    } else if (look(plan).larger > 1) {
      event.preventDefault();
      move(plan, now.x - fingers.x, now.y - fingers.y);
    }
    fingers = { plan, ...now };
  }, { passive: false });
  for (const kind of ["touchend", "touchcancel"]) {
    document.addEventListener(kind, (event) => {
      fingers = fingers && event.touches.length ? { plan: fingers.plan, ...middle(event.touches) } : null;
    });
  }
  let dragged = null;
  document.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "mouse") return;
    moved = 0;
    const plan = planOf(event);
    if (plan && event.button === 0) dragged = { plan, x: event.clientX, y: event.clientY };
  });
  document.addEventListener("pointermove", (event) => {
    if (!dragged?.plan.isConnected || event.pointerType !== "mouse") return;
    moved += Math.hypot(event.clientX - dragged.x, event.clientY - dragged.y);
    if (look(dragged.plan).larger > 1) move(dragged.plan, event.clientX - dragged.x, event.clientY - dragged.y);
    Object.assign(dragged, { x: event.clientX, y: event.clientY });
  });
  for (const kind of ["pointerup", "pointercancel"]) document.addEventListener(kind, () => { dragged = null; });

  // --- a choice -----------------------------------------------------------------------------------------------

  const addressOf = (plan, group) => `${plan.dataset.plan}&viewpoint=${encodeURIComponent(group.dataset.viewpoint)}`;
  document.addEventListener("click", (event) => {
    const plan = planOf(event);
    if (!plan || moved > 10) return;
    const screen = plan.getScreenCTM();
    const near = [...plan.querySelectorAll("g[data-viewpoint]")].map((group) => {
      const at = new DOMPoint(Number(group.dataset.x), Number(group.dataset.y)).matrixTransform(screen);
      return [Math.hypot(at.x - event.clientX, at.y - event.clientY), group];
    }).sort((a, b) => a[0] - b[0]);
    if (!near.length || near[0][0] > FAR_PX) return;
    const under = near.filter(([px]) => px <= FINGER_PX);
    if (under.length > 1) offer(plan, under.map(([, group]) => group));
    else location.assign(addressOf(plan, near[0][1]));
  });
  function offer(plan, groups) {
    const dialog = document.getElementById("plan-choice");
    dialog.querySelector("[data-count]").textContent = String(groups.length);
    dialog.querySelector("ul").replaceChildren(...groups.map((group) => {
      const item = document.createElement("li");
      const link = document.createElement("a");
      link.className = "button";
      link.href = addressOf(plan, group);
      const sample = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      sample.setAttribute("viewBox", "-16 -16 32 32");
      sample.setAttribute("class", "plan-sample");
      sample.setAttribute("aria-hidden", "true");
      sample.append(...[...group.querySelector("g").cloneNode(true).children]);
      const name = document.createElement("strong");
      name.textContent = group.dataset.viewpoint;
      const word = document.createElement("span");
      word.textContent = group.dataset.word;
      link.append(sample, name, word);
      item.append(link);
      return item;
    }));
    dialog.showModal();
  }

  const showAll = () => document.querySelectorAll("svg[data-plan]").forEach(show);
  document.addEventListener("part-changed", showAll);
  showAll();
})();
