// Timelines by uPlot in place of the SVG that the server drew: values under the pointer, zoom, and one pointer and zoom
// for all timelines with the same times. By keyboard: arrows, plus, minus and 0 on the plot.
"use strict";
(() => {
  const COLOURS = ["--accent", "--focus", "--good", "--soft"], DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
  const HEIGHT = 240, RADIUS = 4;
  const plots = new Set();

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", () => plots.forEach((plot) => plot.redraw(false)));

  const clock = (zone, seconds) => {
    const parts = { year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", timeZone: zone };
    return new Intl.DateTimeFormat("sv-SE", parts).format(new Date(1000 * seconds));  // as ISO: 2026-06-21 14:05
  };

  const number = (value, digits) => value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits })
    .replaceAll(",", "\u202f").replace("-", "\u2212");

  // Labels of the time axis: clock or date, and under it what the label before does not say already.
  const timeLabels = (zone, splits, step) => {
    let last = "";
    return splits.map((at) => {
      const [day, minutes] = clock(zone, at).split(" ");
      if (step >= 86400) return step >= 300 * 86400 ? day.slice(0, 4) : day;
      const label = day === last ? minutes : `${minutes}\n${day}`;
      last = day;
      return label;
    });
  };

  const isBeyond = (limit, value) => limit && (limit.isMinimum ? value < limit.number : value > limit.number);

  const valueText = (data, series, value, index) => {
    if (value == null) return "";
    const { limit } = data, label = series.labels[index];
    const share = limit ? 100 * Math.abs(value / limit.number - 1) : 0;
    const excess = isBeyond(limit, value) ? ` \u25b2 ${number(share, share < 10 ? 1 : 0)} % beyond the limit` : "";
    return `${number(value, data.digits)} ${data.unit}${label ? ` (${label})` : ""}${excess}`;
  };

  const drawLine = (u, from, to, colour, dash) => {
    const { ctx } = u;
    ctx.strokeStyle = css(colour);
    ctx.lineWidth = 1.5 * uPlot.pxRatio;
    ctx.setLineDash(dash.map((length) => length * uPlot.pxRatio));
    ctx.beginPath();
    ctx.moveTo(...from);
    ctx.lineTo(...to);
    ctx.stroke();
    ctx.setLineDash([]);
  };

  const write = (u, text, x, y, align, colour) => {
    const { ctx } = u;
    ctx.font = `${12 * uPlot.pxRatio}px ${getComputedStyle(document.body).fontFamily}`;
    ctx.fillStyle = css(colour);
    ctx.textAlign = align;
    ctx.textBaseline = "alphabetic";
    ctx.fillText(text, x, y);
    return ctx.measureText(text).width;
  };

  // Versions as upright lines with labels above the plot, unless a label would cover the one before; the limit with its label.
  const drawLines = (u, data) => {
    const { left, top, width, height } = u.bbox, ratio = uPlot.pxRatio;
    let free = -Infinity;
    for (const [at, label] of data.marks) {
      const x = u.valToPos(at, "x", true);
      if (x < left || x > left + width) continue;
      drawLine(u, [x, top], [x, top + height], "--edge", [2, 3]);
      if (x > free) free = x + write(u, label, x, top - 5 * ratio, "center", "--soft") + 6 * ratio;
    }
    if (!data.limit) return;
    const y = u.valToPos(data.limit.number, "y", true);
    drawLine(u, [left, y], [left + width, y], "--bad", [8, 4]);
    // The label is on the side of the limit that the last values are not on.
    const isBelow = u.data.slice(1).some((values) => values.at(-1) > data.limit.number);
    write(u, data.limit.label, left + width - 4 * ratio, y + (isBelow ? 14 : -5) * ratio, "right", "--bad");
  };

  const drawDots = (u, data) => {
    const { ctx } = u, { min, max } = u.scales.x;
    ctx.save();
    ctx.setLineDash([]);
    ctx.lineWidth = 1.5 * uPlot.pxRatio;
    data.series.forEach((series, place) => series.values.forEach((value, index) => {
      const at = data.times[index];
      if (value == null || at < min || at > max) return;
      const colour = css(isBeyond(data.limit, value) ? "--bad" : COLOURS[place % COLOURS.length]), card = css("--card");
      ctx.fillStyle = series.hollow[index] ? card : colour;
      ctx.strokeStyle = series.hollow[index] ? colour : card;
      ctx.beginPath();
      ctx.arc(u.valToPos(at, "x", true), u.valToPos(value, "y", true), RADIUS * uPlot.pxRatio, 0, 2 * Math.PI);
      ctx.fill();
      ctx.stroke();
    }));
    ctx.restore();
  };

  // What is shown if it is not all, and the way back.
  const zoomBar = (place, zone, whole) => {
    const bar = document.createElement("p"), output = document.createElement("output"), button = document.createElement("button");
    bar.className = "zoomed inline";
    button.type = "button";
    button.className = "quiet";
    button.textContent = "Whole time";
    button.addEventListener("click", whole);
    bar.append(output, button);
    bar.hidden = true;
    place.after(bar);
    return (min, max) => {
      bar.hidden = min == null;
      output.textContent = min == null ? "" : `${clock(zone, min)} to ${clock(zone, max)}`;
    };
  };

  const keys = (u, data) => (event) => {
    const { min, max } = u.scales.x, at = u.cursor.idx, last = data.times.length - 1;
    const show = (index) => u.setCursor({ left: u.valToPos(data.times[index], "x"), top: 1 }, true, true);
    const scale = (factor) => {
      const middle = at == null ? (min + max) / 2 : data.times[at], half = factor * (max - min) / 2;
      u.setScale("x", { min: Math.max(data.span[0], middle - half), max: Math.min(data.span[1], middle + half) });
    };
    const actions = {
      ArrowLeft: () => show(at == null ? last : Math.max(0, at - 1)),
      ArrowRight: () => show(at == null ? 0 : Math.min(last, at + 1)),
      "+": () => scale(0.5),
      "-": () => scale(2),
      0: () => u.setScale("x", wholeTime(data)),
    };
    if (!(event.key in actions) || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    actions[event.key]();
  };

  const wholeTime = ({ span: [min, max] }) => ({ min, max });

  // The legend is in the plot, above all values.
  const valueRange = (u, { bounds: [low, high] }) => {
    const legend = u.over.querySelector(".u-legend").offsetHeight, height = u.over.clientHeight || HEIGHT;
    return [low, low + (high - low) / Math.max(0.3, 1 - legend / height)];
  };

  const fit = (u, data) => {
    const [min, max] = valueRange(u, data);
    u.setScale("y", { min, max });
  };

  const options = (place, data, showZoom) => {
    const axis = { stroke: () => css("--soft"), grid: { stroke: () => css("--line"), width: 1 }, ticks: { stroke: () => css("--edge"), width: 1, size: 5 } };
    const group = data.span.join();
    // Above the values the legend has its space, but no accuracy is above 100 %.
    const below = (u, splits) => splits.map((value) => (data.unit === "%" && value > 100 ? null : value));
    const isWhole = (min, max) => min <= data.span[0] && max >= data.span[1];
    // All timelines with the same times zoom together, also by keyboard.
    const share = (u, key) => {
      if (key !== "x") return;
      const { min, max } = u.scales.x;
      showZoom(...(isWhole(min, max) ? [] : [min, max]));
      plots.forEach((other) => {
        if (other.group === group && (other.scales.x.min !== min || other.scales.x.max !== max)) other.setScale("x", { min, max });
      });
    };
    return {
      width: place.clientWidth, height: HEIGHT, padding: [20, 14, 0, 0],
      tzDate: (seconds) => uPlot.tzDate(new Date(1000 * seconds), data.zone),
      scales: {
        x: { time: true, min: data.span[0], max: data.span[1], range: (u, min, max) => [min, max] },
        y: { range: (u) => valueRange(u, data) },
      },
      axes: [
        { ...axis, space: 90, values: (u, splits, place, space, step) => timeLabels(data.zone, splits, step) },
        { ...axis, filter: below, grid: { ...axis.grid, filter: below }, ticks: { ...axis.ticks, filter: below }, values: (u, splits) => splits.map((value) => (value == null ? "" : String(value))), size: (u, labels) => 16 + 7.5 * Math.max(3, ...(labels ?? []).map((label) => label.length)) },
      ],
      series: [
        { label: "Time", value: (u, at) => (at == null ? "" : clock(data.zone, at)) },
        ...data.series.map((series, index) => ({
          label: series.name, stroke: () => css(COLOURS[index % COLOURS.length]), width: 2, dash: DASHES[index % DASHES.length],
          spanGaps: true, points: { show: false }, value: (u, value, of, at) => valueText(data, series, value, at),
        })),
      ],
      cursor: {
        // The zoom is shared by setScale.
        sync: { key: group, scales: ["x", null], filters: { pub: (type) => type === "mousemove", sub: () => true } },
        bind: { dblclick: (u) => () => u.setScale("x", wholeTime(data)) },
        y: false, points: { size: 13 },
      },
      legend: { mount: (u, table) => u.over.append(table) },
      hooks: { drawAxes: [(u) => drawLines(u, data)], draw: [(u) => drawDots(u, data)], setScale: [share], ready: [(u) => fit(u, data)] },
    };
  };

  const enhance = (figure) => {
    const data = JSON.parse(figure.querySelector("script").textContent);
    const svg = figure.querySelector("svg"), place = document.createElement("div");
    figure.classList.add("plotted");
    place.className = "plot";
    place.tabIndex = 0;
    place.setAttribute("role", "img");
    place.setAttribute("aria-label", `${svg.querySelector("title").textContent}. Arrow keys show values, plus and minus zoom, 0 shows all.`);
    svg.after(place);
    const showZoom = zoomBar(place, data.zone, () => plot.setScale("x", wholeTime(data)));
    const plot = new uPlot(options(place, data, showZoom), [data.times, ...data.series.map((one) => one.values)], place);
    plot.group = data.span.join();
    plots.add(plot);
    place.addEventListener("keydown", keys(plot, data));
    new ResizeObserver(() => {
      if (!place.clientWidth || place.clientWidth === plot.width) return;
      plot.setSize({ width: place.clientWidth, height: HEIGHT });
      fit(plot, data);
    }).observe(place);
  };

  const start = () => {
    plots.forEach((plot) => {
      if (plot.root.isConnected) return;
      plots.delete(plot);
      plot.destroy();
    });
    document.querySelectorAll(".timeline:not(.plotted):has(> svg)").forEach(enhance);
    if (plots.size) document.querySelectorAll("[data-plot-help]").forEach((one) => (one.hidden = false));
  };
  document.addEventListener("htmx:load", start);
  start();
})();
