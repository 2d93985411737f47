// The field map: one link that follows the pointer or the arrow keys from heliostat to heliostat, and zoom.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const directions = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const most = 64, named = 60;
  // The visible part of the map: its upper left corner and its share. It is in the URL, and stays when parts are replaced.
  const match = location.hash.match(/^#map=(-?[\d.]+),(-?[\d.]+),([\d.]+)$/);
  let view = match && { x: Number(match[1]), y: Number(match[2]), share: Number(match[3]) };

  const add = (parent, name, attributes, text) => {
    const made = parent.appendChild(document.createElementNS(SVG, name));
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };

  const read = (map) => {
    const half = Number(map.dataset.side) / 2;
    return [...map.querySelectorAll("[data-names]")].flatMap((path) => {
      const places = [...path.getAttribute("d").matchAll(/M(-?[\d.]+) (-?[\d.]+)/g)], texts = path.dataset.texts.split("|");
      return path.dataset.names.split("|").map((name, k) => ({ name, text: texts[k], x: Number(places[k][1]) + half, y: Number(places[k][2]) + half }));
    });
  };

  const begin = () => {
    const map = document.querySelector("[data-map]");
    if (!map || map.dataset.begun) return;
    map.dataset.begun = "yes";
    const side = Number(map.dataset.side), width = map.viewBox.baseVal.width, height = map.viewBox.baseVal.height;
    const mirrors = read(map), bar = document.querySelector("[data-bar]");
    if (!mirrors.length) return;
    const labels = add(map, "g", { class: "labels" });
    const link = add(map, "a", { tabindex: "0" }), title = add(link, "title", {});
    const frame = add(link, "rect", { width: side + 3, height: side + 3 });
    let at = null, last = null, moved = 0;
    const pointers = new Map();

    const go = (mirror) => {
      at = mirror;
      link.setAttribute("href", `/heliostats/${encodeURIComponent(mirror.name)}`);
      link.setAttribute("aria-label", `${mirror.name}: ${mirror.text}`);
      title.textContent = `${mirror.name}: ${mirror.text}`;
      frame.setAttribute("x", mirror.x - side / 2 - 1.5);
      frame.setAttribute("y", mirror.y - side / 2 - 1.5);
    };

    const show = () => {
      const share = view ? view.share : 1, w = width * share, h = height * share;
      const x = view ? view.x : 0, y = view ? view.y : 0;
      map.setAttribute("viewBox", `${x} ${y} ${w} ${h}`);
      map.classList.toggle("zoomed", share < 1);
      const seen = mirrors.filter((m) => m.x > x && m.x < x + w && m.y > y && m.y < y + h);
      labels.replaceChildren();
      if (seen.length <= named)
        for (const m of seen) add(labels, "text", { class: "name middle", transform: `translate(${m.x} ${m.y + side / 2 + 4 * share}) scale(${share})` }, m.name);
      const metre = Number(map.dataset.perMetre) / share, longest = width / 4 / metre, power = 10 ** Math.floor(Math.log10(longest));
      const length = power * (longest >= 5 * power ? 5 : longest >= 2 * power ? 2 : 1);
      bar.querySelector("path").setAttribute("d", `M0 -5v5h-${length * metre}v-5`);
      bar.querySelector("text").textContent = `${Number(length.toPrecision(3))} m`;
    };

    const look = (x, y, share) => {
      share = Math.min(1, Math.max(1 / most, share));
      const inside = (value, whole) => Math.min(Math.max(value, 0), whole * (1 - share));
      view = share === 1 ? null : { x: inside(x, width), y: inside(y, height), share };
      show();
      const hash = view ? `#map=${view.x.toFixed(1)},${view.y.toFixed(1)},${view.share.toPrecision(4)}` : "";
      history.replaceState(history.state, "", location.pathname + location.search + hash);
    };

    const zoom = (factor, x, y) => {
      const { x: left, y: top, share } = view || { x: 0, y: 0, share: 1 };
      const next = Math.min(1, Math.max(1 / most, share / factor));
      look(x - (x - left) * next / share, y - (y - top) * next / share, next);
    };

    const place = (event) => {
      const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(map.getScreenCTM().inverse());
      return [point.x, point.y];
    };

    // Fingers are wider than mirrors: heliostats within 20 pixels count.
    const near = (x, y) => {
      let best = null, least = Math.max(side, 20 / map.getScreenCTM().a);
      for (const m of mirrors) {
        const distance = Math.hypot(m.x - x, m.y - y);
        if (distance < least) { best = m; least = distance; }
      }
      return best;
    };

    map.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoom(Math.exp(-event.deltaY / 300), ...place(event));
    }, { passive: false });

    map.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, event);
      moved = 0;
    });
    map.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) {
        const mirror = near(...place(event));
        if (mirror) go(mirror);
        return;
      }
      moved += Math.hypot(event.clientX - before.clientX, event.clientY - before.clientY);
      const [a, b] = place(before), [x, y] = place(event);
      if (pointers.size === 2) {
        const [other] = [...pointers.values()].filter((one) => one.pointerId !== event.pointerId), [u, v] = place(other);
        zoom(Math.hypot(x - u, y - v) / Math.max(Math.hypot(a - u, b - v), 1e-6), u, v);
      } else if (view && moved > 4) {
        if (!map.hasPointerCapture(event.pointerId)) map.setPointerCapture(event.pointerId);
        look(view.x + a - x, view.y + b - y, view.share);
      }
      pointers.set(event.pointerId, event);
    });
    for (const end of ["pointerup", "pointercancel", "pointerleave"])
      map.addEventListener(end, (event) => pointers.delete(event.pointerId));
    map.addEventListener("click", (event) => {
      if (moved > 4) { event.preventDefault(); return; }
      if (event.target.closest("a") || !event.detail) return;
      const mirror = near(...place(event));
      if (mirror) { go(mirror); location.assign(link.getAttribute("href")); }
    });
    link.addEventListener("dragstart", (event) => event.preventDefault());

    link.addEventListener("keydown", (event) => {
      if (!directions[event.key]) return;
      event.preventDefault();
      const [dx, dy] = directions[event.key];
      let best = null, least = Infinity;
      for (const m of mirrors) { // the nearest one in the direction; sideways distance counts twice
        const along = (m.x - at.x) * dx + (m.y - at.y) * dy, across = Math.abs((m.x - at.x) * dy) + Math.abs((m.y - at.y) * dx);
        if (along > 0.5 && along + 2 * across < least) { best = m; least = along + 2 * across; }
      }
      if (!best) return;
      go(best);
      if (view) look(best.x - width * view.share / 2, best.y - height * view.share / 2, view.share);
    });

    for (const button of document.querySelectorAll("[data-zoom]"))
      button.addEventListener("click", () => {
        if (button.dataset.zoom === "whole") return look(0, 0, 1);
        const seen = map.viewBox.baseVal;
        zoom(button.dataset.zoom === "in" ? 2 : 0.5, seen.x + seen.width / 2, seen.y + seen.height / 2);
      });

    go(mirrors[0]);
    if (view) look(view.x, view.y, view.share); else show();
  };

  // Empty form fields are left out of the URL.
  document.addEventListener("htmx:configRequest", (event) => {
    if (event.target.id === "find")
      for (const [name, value] of Object.entries(event.detail.parameters)) if (value === "") delete event.detail.parameters[name];
  });
  document.addEventListener("htmx:afterSettle", begin);
  begin();
})();
