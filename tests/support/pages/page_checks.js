// What tests measure in a page: sizes of touch targets, horizontal scrolling, the order of the focus.
(() => {
  const shown = (e) => e.checkVisibility({ visibilityProperty: true, opacityProperty: true }) && e.getClientRects().length > 0;
  const behind = () => [...document.querySelectorAll("dialog:modal")].at(-1);
  const name = (e) => `<${e.tagName.toLowerCase()}${e.id ? "#" + e.id : ""} class="${e.getAttribute("class") || ""}"> ${(e.getAttribute("aria-label") || e.innerText || e.value || e.getAttribute("name") || "").trim().slice(0, 50)}`;
  const inText = (a) => {
    if (a.matches(".button, [role=button], .target, nav a, .tabs a, .steps a, .pager a, .product")) return false;
    return getComputedStyle(a).display === "inline" || a.closest("td, th, p, dd, li, svg, h1, h2, h3, caption, figcaption");
  };
  const controls = () => [...document.querySelectorAll("a[href], button, input:not([type=hidden]), select, textarea, summary")].filter(shown);
  window.check = {
    sideways: () => {
      const wide = document.documentElement.clientWidth;
      if (document.documentElement.scrollWidth <= wide) return [];
      return [`${document.documentElement.scrollWidth} px of ${wide}`, ...[...document.querySelectorAll("body *")]
        .filter((e) => shown(e) && e.getBoundingClientRect().right > wide + 1 && !e.closest(".scroll *")).slice(0, 3).map(name)];
    },
    small: () => controls().flatMap((e) => {
      if (e.matches("a") && inText(e)) return [];
      const box = (e.matches("[type=checkbox], [type=radio]") && e.closest("label") || e).getBoundingClientRect();
      if (box.bottom < 0) return []; // the skip link, until it has the focus
      const least = e.matches(".target") ? 76 : 44;
      return box.height < least - 0.5 || box.width < 24 ? [`${Math.round(box.width)} × ${Math.round(box.height)} px: ${name(e)}`] : [];
    }),
    follow: () => {
      window.focused = [];
      document.addEventListener("focusin", (event) => {
        const e = event.target;
        const style = getComputedStyle(e);
        const ring = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2;
        window.focused.push({ e, ring, box: e.getBoundingClientRect(), y: scrollY });
      });
      const groups = new Set();
      return controls().concat([...document.querySelectorAll("[tabindex='0']")].filter(shown)).filter((e) => {
        if (e.disabled || e.tabIndex < 0) return false;
        if (e.type !== "radio") return true;
        const first = !groups.has(e.name);
        groups.add(e.name);
        return first;
      }).map((e) => { e.dataset.tabbable = ""; return name(e); }).length;
    },
    way: () => {
      const faults = [];
      const seen = new Set(window.focused.map((f) => f.e));
      for (const e of document.querySelectorAll("[data-tabbable]")) {
        if (!seen.has(e) && e.type !== "radio") faults.push(`not reached: ${name(e)}`);
      }
      for (const f of window.focused) if (!f.ring && f.e.id !== "content") faults.push(`focus not to be seen: ${name(f.e)}`);
      for (const e of document.querySelectorAll("[tabindex]")) if (e.tabIndex > 0) faults.push(`order forced: ${name(e)}`);
      for (let i = 1; i < window.focused.length; i += 1) {
        const [a, b] = [window.focused[i - 1], window.focused[i]];
        if (a.e.closest("svg")) continue; // a drawing is read along its arrows
        if (a.e.parentElement !== b.e.parentElement || !a.e.compareDocumentPosition(b.e) & 4) continue;
        if (b.box.bottom + b.y <= a.box.top + a.y + 1) faults.push(`before it on the page, after it in order: ${name(b.e)}`);
      }
      return [...new Set(faults)];
    },
    behind: () => { const d = behind(); return d ? d.contains(document.activeElement) || document.activeElement === document.body : false; },
  };
})();
