"use strict";
(async () => {
  const root = document.documentElement;
  const narrow = () => window.innerWidth < 720;
  const forNewTab = (event) => event.ctrlKey || event.metaKey || event.shiftKey;

  // ---- parts: one is open, and the others are text until the reader opens them ------------------------------
  const parts = [...document.querySelectorAll(".part")];
  const tabs = document.querySelector(".tabs"), { title } = document;

  /* The part or row that the address names. */
  function place() {
    return choices.address()[0];
  }

  /* Make the elements of a part from its text, in which the templates escaped what strangers wrote. */
  function build(part) {
    const text = part.querySelector(":scope > noscript")?.textContent;
    if (text !== undefined) part.innerHTML = text;
  }

  /* Open the part of the address, #scenario or #scenario/method; an address without a place opens the first. */
  function openPart() {
    const name = place();
    const wanted = parts.find((one) => name === one.id || name.startsWith(`${one.id}/`));
    const part = wanted ?? (name ? parts.find((one) => !one.hidden) : parts[0]);
    const moved = part?.hidden;
    for (const one of parts) one.hidden = one !== part;
    for (const link of tabs.querySelectorAll("a")) {
      const here = part && link.hash.slice(1) === part.id;
      link.ariaCurrent = here ? "true" : null;
      if (here) link.parentElement.scrollLeft = link.offsetLeft - 40;
    }
    if (part) build(part);
    // The tabs stay where they are: a part that the reader has scrolled into begins below them.
    if (moved) window.scrollTo({ top: Math.min(window.scrollY, document.querySelector(".top").offsetHeight), behavior: "instant" });
    return part;
  }

  const measureTabs = () => root.style.setProperty("--tabs", `${tabs.offsetHeight}px`);
  root.classList.remove("no-script");
  parts.slice(1).forEach((part) => { part.hidden = true; });
  openPart(); // before the data are unpacked: no other part flashes up
  measureTabs();

  // ---- theme: the reader's choice, otherwise the system's ---------------------------------------------------
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const theme = () => root.dataset.theme || (dark.matches ? "dark" : "light");
  const nameTheme = () => { button.textContent = theme() === "dark" ? "Light theme" : "Dark theme"; };

  // A file opened from disk may have no storage.
  try { root.dataset.theme = localStorage.getItem("theme") || ""; } catch { /* the system's theme */ }
  button.addEventListener("click", () => {
    root.dataset.theme = theme() === "dark" ? "light" : "dark";
    try { localStorage.setItem("theme", root.dataset.theme); } catch { /* until the page is closed */ }
    nameTheme();
  });
  dark.addEventListener("change", nameTheme);
  nameTheme();

  // ---- data, and the library that draws charts ---------------------------------------------------------------
  const packed = Uint8Array.from(atob(document.getElementById("data").textContent), (one) => one.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const library = new Promise((done) => { document.addEventListener("DOMContentLoaded", done); }); // it comes last
  const [data] = await Promise.all([new Response(unpacked).json(), library]);

  // ---- the tip: what is behind a number, by mouse, by tap and by key ----------------------------------------
  const tip = document.getElementById("tip");
  let leaving;

  function showTip(text, { left, top, bottom }) {
    clearTimeout(leaving);
    tip.textContent = text;
    (document.querySelector("dialog[open]") ?? document.body).append(tip); // above an open dialog
    tip.showPopover();
    const above = top - 6 - tip.offsetHeight > 0; // below, it would catch a pointer that goes down a column
    tip.style.left = `${Math.max(Math.min(left, window.innerWidth - tip.offsetWidth - 8), 8)}px`;
    tip.style.top = `${above ? top - 6 - tip.offsetHeight : bottom + 6}px`;
  }

  const hideTip = () => tip.hidePopover();
  /* Hide the tip unless the pointer goes to it. */
  const leaveTip = () => { clearTimeout(leaving); leaving = setTimeout(hideTip, 200); };
  const showNote = (element) => showTip(element.dataset.note, element.getBoundingClientRect());
  const noted = (event) => event.target.closest?.("[data-note]");
  for (const [begin, end] of [["focusin", "focusout"], ["mouseover", "mouseout"]]) {
    document.addEventListener(begin, (event) => { if (noted(event)) showNote(noted(event)); });
    document.addEventListener(end, (event) => { if (noted(event)) leaveTip(); });
  }
  tip.addEventListener("mouseenter", () => clearTimeout(leaving));
  tip.addEventListener("mouseleave", leaveTip);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !tip.matches(":popover-open")) return;
    event.preventDefault(); // an open row stays open
    hideTip();
  });
  document.addEventListener("scroll", () => {
    if (!tip.matches(":popover-open")) return;
    const focused = document.activeElement.closest("[data-note]:focus-visible"); // it may have moved the page
    if (focused) showNote(focused);
    else hideTip();
  }, { capture: true, passive: true });

  const NOTED = ":is(td, .turned)[data-note]";

  /* One number of a table is a stop of the Tab key; the arrow keys lead to the others. */
  function roam(table) {
    const cells = () => [...table.rows]
      .filter((row) => row.checkVisibility())
      .map((row) => [...row.querySelectorAll(NOTED)].filter((cell) => cell.checkVisibility()))
      .filter((row) => row.length);
    /* What hides a number may have hidden the one where the Tab key stops. */
    table.stop = () => {
      const shown = cells().flat();
      if (shown.some((cell) => cell.tabIndex === 0)) return;
      for (const cell of table.querySelectorAll(NOTED)) cell.tabIndex = -1;
      if (shown.length) shown[0].tabIndex = 0;
    };
    for (const cell of table.querySelectorAll(NOTED)) cell.tabIndex = -1;
    table.stop();
    table.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
      const here = event.target.closest(NOTED);
      if (!step || !here) return;
      const all = cells(), row = all.findIndex((row) => row.includes(here));
      const line = all[row + step[0]], at = all[row].indexOf(here) + step[1];
      const next = line?.[Math.min(at, line.length - 1)];
      event.preventDefault();
      if (!next) return;
      here.tabIndex = -1;
      next.tabIndex = 0;
      next.focus();
    });
  }

  // ---- a scenario: its filters, its table and its picture ---------------------------------------------------
  function prepare(part) {
    const table = part.querySelector(".board");
    const heads = [...table.tHead.rows[0].cells];
    const bodies = [...table.tBodies];
    const rows = bodies.flatMap((body) => [...body.rows].slice(1).map((row) => ({ row, body })));
    const form = part.querySelector(".filters");
    const [all, grouped] = part.querySelectorAll(".choices input");
    const usual = heads.find((head) => head.ariaSort !== "none"), first = usual.ariaSort;
    let column, direction;

    /* Take the choices from the address. */
    function take() {
      const [wanted, order] = choices.read(part, heads), head = wanted ?? usual;
      const usually = head === usual ? first : head.querySelector("button").dataset.first;
      column = heads.indexOf(head);
      direction = wanted && ["ascending", "descending"].includes(order) ? order : usually;
    }

    function compare(a, b) {
      const [x, y] = [a, b].map(({ row }) => row.cells[column].dataset.order);
      if (!x || !y) return (x ? 0 : 1) - (y ? 0 : 1); // missing values come last in both directions
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, "en") : x - y;
      return direction === "ascending" ? order : -order;
    }

    function arrange() {
      table.classList.toggle("grouped", grouped.checked);
      table.parentElement.classList.toggle("all", all.checked);
      for (const one of [...rows].sort(compare)) (grouped.checked ? one.body : bodies[0]).append(one.row);
      heads.forEach((head, number) => { head.ariaSort = number === column ? direction : "none"; });
      table.stop?.();
    }

    function filter() {
      const { text, tier } = form.elements;
      const wanted = text.value.trim().toLowerCase();
      const divisions = [...form.querySelectorAll("[name=division]:checked")].map((box) => box.value);
      const methods = new Set();
      for (const { row } of rows) {
        const name = row.querySelector(".name").textContent;
        row.hidden = !name.toLowerCase().includes(wanted) || !divisions.includes(row.dataset.division)
          || (tier?.value && row.dataset.tier !== tier.value);
        if (!row.hidden) methods.add(name);
      }
      for (const body of bodies) body.rows[0].hidden = rows.every((one) => one.body !== body || one.row.hidden);
      form.elements.count.value = `${methods.size} of ${rows.length} ${rows.length === 1 ? "method" : "methods"}`;
      table.stop?.();
      return methods;
    }

    part.picture = () => drawPlane(part, form.elements.across.value, form.elements.up.value, filter());
    part.keep = () => {
      const isUsual = heads[column] === usual && direction === first;
      choices.keep(part, isUsual ? null : heads[column], direction);
    };
    table.tHead.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (!button) return;
      const chosen = heads.indexOf(button.parentElement);
      const other = { ascending: "descending", descending: "ascending" };
      direction = chosen === column ? other[direction] : button.dataset.first;
      column = chosen;
      arrange();
      part.keep();
    });
    part.querySelector(".choices").addEventListener("input", () => { arrange(); part.keep(); });
    let waiting;
    form.addEventListener("input", () => {
      filter();
      part.keep();
      clearTimeout(waiting);
      waiting = setTimeout(part.picture, 150); // a drawing for each letter would hold up the next one
    });
    part.take = () => { take(); arrange(); part.picture(); };
    take();
    if (location.hash.includes("?")) arrange(); // the rows come in the usual order
    roam(table);
  }

  function prepareFiles(part) {
    const form = part.querySelector(".filters");
    form.addEventListener("input", () => {
      const rows = [...part.querySelector("tbody").rows];
      const wanted = form.elements.text.value.trim().toLowerCase();
      for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
      form.elements.count.value = `${rows.filter((row) => !row.hidden).length} of ${rows.length} ${rows.length === 1 ? "file" : "files"}`;
    });
  }

  // ---- charts ----------------------------------------------------------------------------------------------
  function showPoint(handler, event, item, value) {
    if (!value) return leaveTip();
    const isNamed = (name) => ["across", "up"].includes(name); // in its own text
    const lines = Object.entries(value).map(([name, text]) => (isNamed(name) ? text : `${name}: ${text}`));
    showTip(lines.join("\n"), { left: event.clientX + 12, top: event.clientY, bottom: event.clientY + 8 });
  }

  async function draw(element, spec) {
    // `ast` interprets expressions: the policy of the page forbids code made from text.
    const options = { actions: false, ast: true, renderer: "svg", defaultStyle: false, tooltip: showPoint };
    // Vega sets its own class names on the element that it draws in, and asks for its width.
    const place = element.latest = element.appendChild(document.createElement("div"));
    const { view } = await vegaEmbed(place, spec, options);
    view.addEventListener("click", (event, item) => { if (item?.datum?.anchor) location.hash = item.datum.anchor; });
    if (element.latest === place) element.replaceChildren(place); // the reader may have chosen again meanwhile
  }

  const sizeOfPlane = () => (narrow() ? "narrow" : window.innerWidth < 1340 ? "wide" : "full");

  /* The note on methods outside a picture without those that are hidden. */
  function noteOf(note, methods) {
    const start = note.indexOf(": ") + 2;
    const isShown = (text) => [...methods].some((name) => text.startsWith(`${name} (`));
    const left = note.slice(start, -1).split("; ").filter(isShown);
    return left.length ? `${note.slice(0, start)}${left.join("; ")}.` : "";
  }

  /* The template with its places filled by points, axes and labels; hidden methods have neither. */
  function drawPlane(part, across, up, methods) {
    const element = part.querySelector("[data-plane]");
    const plane = data.scenarios[part.id].planes[`${across}, ${up}`];
    const size = part.size = sizeOfPlane();
    const places = { ...plane.places, ...plane[size] };
    for (const name of ["@points", "@leaders", "@left", "@right"]) {
      places[name] = places[name].filter((one) => methods.has(one.method));
    }
    // A front holds for all methods of its division.
    const whole = new Set(plane.places["@points"].filter((one) => !methods.has(one.method)).map((one) => one.division));
    places["@corners"] = places["@corners"].filter((one) => !whole.has(one.division));
    const empty = places["@points"].length === 0;
    element.classList.toggle("empty", empty);
    const none = plane.places["@points"].length ? "" : `No method here has both ${up} and ${across}. `;
    part.querySelector("[data-plane-note]").textContent =
      methods.size ? none + noteOf(plane.note, methods) : "No method matches the filters.";
    element.latest = null; // a drawing under way is out of date
    if (empty) return element.replaceChildren();
    const fill = (name, value) => (typeof value === "string" && value in places ? places[value] : value);
    draw(element, JSON.parse(JSON.stringify(data.planes[size]), fill));
  }

  /* Draw the charts of a part that have two sizes. */
  function drawOthers(part) {
    const size = narrow() ? "narrow" : "wide";
    part.isNarrow = narrow();
    for (const name of ["frontier", "decoders"]) {
      for (const one of part.querySelectorAll(`[data-${name}]`)) draw(one, data.scenarios[part.id][`${size}_${name}`]);
    }
  }

  const text = (value) => (value === null ? "–" : value.toFixed(2).replace(/^-(0\.00)$/, "$1"));
  const words = ([value, low, high]) => text(value) + (low === null ? "" : ` [${text(low)}, ${text(high)}]`);

  /* The evaluations of a run in order: stage and step of each point of the curves of old skills and targets. */
  function places({ steps, targets }) {
    const each = (from) => targets.flatMap((_, stage) => from.map((step) => [stage, step]));
    return { retained: [[0, 0], ...each(steps)], target: each([0, ...steps]) };
  }

  /* Stages that end when the target is learned, and those of agents, have no common number of steps. */
  const whole = (row, one) => row.elsewhere || one.to_criterion;
  const when = (row, one, step) => (whole(row, one) ? (step ? "end" : "start") : String(step));

  function points(series, numbers, at, row, one, perStage) {
    return numbers.flatMap(([y, low, high], index) => {
      if (y === null) return [];
      const [stage, step] = at[index];
      const x = stage * one.steps.at(-1) + step;
      return [{
        series, x, y, low: low ?? y, high: high ?? y, stage: series + (perStage ? stage : ""),
        at: whole(row, one) ? `${when(row, one, step)} of stage ${stage + 1}` : `step ${x}`, success: words([y, low, high]),
      }];
    });
  }

  function drawRun(element) {
    const row = data.rows[element.dataset.run];
    const one = data.scenarios[row.scenario];
    const at = places(one);
    const [retained, target, beside] = data.series;
    const all = points(retained, row.retained, at.retained, row, one, false);
    all.push(...points(target, row.target, at.target, row, one, true));
    if (one.sft && one.sft !== element.dataset.run && !row.elsewhere) {
      const values = data.rows[one.sft].retained.map(([value]) => [value, null, null]);
      all.push(...points(beside, values, at.retained, row, one, false));
    }
    const shown = [...new Set(all.map((point) => point.series))];
    const chart = row.elsewhere ? one.run_elsewhere : one.run;
    draw(element, { ...chart, params: [{ name: "shown", value: shown }], datasets: { points: all } });
  }

  // ---- tables that are long and made when they open -------------------------------------------------
  function table(label, heads, rows) {
    const region = Object.assign(document.createElement("div"),
      { className: "scroll", tabIndex: 0, role: "region", ariaLabel: label });
    const add = (place, name, values) => Object.assign(place.appendChild(document.createElement(name)), values);
    const made = add(region, "table", { className: "plain" });
    const line = (section, texts, scope) => {
      const row = section.insertRow();
      texts.forEach((textContent, number) => {
        const [name, more] = scope === "col" || !number ? ["th", { scope }] : ["td"];
        add(row, name, { textContent, className: number ? "numeric" : "", ...more });
      });
      return row;
    };
    line(made.createTHead(), heads, "col");
    const body = made.createTBody();
    for (const { texts, meaning } of rows) {
      const row = line(body, texts, "row");
      if (meaning) add(row.cells[0], "span", { className: "meaning", textContent: meaning });
    }
    return region;
  }

  const tables = {
    curves(row) {
      const one = data.scenarios[row.scenario];
      const rows = places(one).target.map(([stage, step], index) => {
        const old = row.retained[index - stage]; // the end of a stage is the start of the next
        return { texts: [one.targets[stage], when(row, one, step), words(row.target[index]), words(old)] };
      });
      return table("The curves", ["target", "step", "success on the target", "on the old skills"], rows);
    },
    metrics(row) {
      const rows = row.metrics.map((texts, index) => {
        const [name, description, missing] = data.scenarios[row.scenario].metrics[index];
        return { texts: [name, ...texts], meaning: texts[0] === data.missing ? `Missing: ${missing}` : description };
      });
      const heads = ["metric", "value [95 % interval]", ...Object.keys(row.seeds).map((seed) => `seed ${seed}`)];
      return table("All other metrics and definitions", heads, rows);
    },
  };

  // ---- the section of a row, made when it opens -------------------------------------------------------------
  const dialog = document.getElementById("row");
  let opened, opener;

  document.addEventListener("toggle", ({ target }) => {
    const make = tables[target.dataset?.table];
    if (make && target.open && target.children.length < 2) target.append(make(data.rows[opened]));
  }, true);

  /* On the way back the browser scrolls to the part and takes the focus away: undo both. */
  function stay(link) {
    const top = window.scrollY;
    const undo = () => { window.scrollTo({ top, behavior: "instant" }); link?.focus({ preventScroll: true }); };
    window.addEventListener("hashchange", undo, { once: true });
  }

  function openRow(anchor) {
    opened = anchor;
    dialog.innerHTML = data.rows[anchor].html; // the templates of the page escaped what strangers wrote
    if (!dialog.open) {
      opener = document.activeElement;
      if (!history.state) history.replaceState("followed", "");
      dialog.showModal();
    }
    dialog.querySelector("h2").focus();
    dialog.scrollTop = 0;
    drawRun(dialog.querySelector("[data-run]"));
  }

  dialog.addEventListener("click", (event) => {
    const chosen = event.target.closest("[data-seed]");
    if (!chosen) return;
    const matrix = dialog.querySelector(".matrix");
    const body = matrix.tBodies[0];
    matrix.mean ??= body.innerHTML;
    body.innerHTML = matrix.mean;
    const seed = data.rows[opened].seeds[chosen.dataset.seed];
    if (seed) [...body.rows].forEach((row, stage) => [...row.cells].slice(1).forEach((cell, task) => {
      const value = seed[stage][task];
      cell.firstChild.data = text(value);
      cell.className = cell.className.replace(/^\S+/, value === null ? "none" : `s${Math.round(value * data.shades)}`);
    }));
    const order = data.scenarios[data.rows[opened].scenario].orders?.[chosen.dataset.seed];
    dialog.querySelector(".order").textContent = order ? ` Targets 1 to ${order.length} of this seed: ${order.join(", ")}.` : "";
    for (const other of chosen.parentElement.children) other.ariaPressed = String(other === chosen);
  });

  dialog.addEventListener("click", (event) => {
    const link = event.target.closest(".bar-top a");
    const outside = event.target === dialog && event.clientX < dialog.getBoundingClientRect().left; // the backdrop
    if ((!link && !outside) || forNewTab(event)) return;
    event.preventDefault();
    if (outside || link.matches(".close")) return dialog.close();
    history.replaceState(history.state, "", link.hash); // Back leads out of the rows
    go();
  });

  dialog.addEventListener("click", async ({ target }) => {
    if (!target.matches(".copy")) return;
    const commands = target.parentElement.nextElementSibling;
    try {
      await navigator.clipboard.writeText(commands.textContent);
      target.textContent = "Copied";
    } catch { // the browser forbids it, or offers it to pages of https alone
      getSelection().selectAllChildren(commands);
      target.textContent = "Selected";
    }
  });

  dialog.addEventListener("close", () => {
    dialog.replaceChildren();
    const own = document.querySelector(`.board .name a[href="#${CSS.escape(opened)}"]`);
    const link = opener.matches("a") && opener.checkVisibility() ? opener : own; // a mark of a chart takes no focus
    const here = place() === opened; // otherwise Back has closed it
    const landed = here && history.state !== "followed";
    link?.focus({ preventScroll: !landed });
    if (landed) {
      history.replaceState(history.state, "", `#${data.rows[opened].scenario}`);
      go();
    } else if (here) {
      stay(link);
      history.back();
    }
  });

  // ---- places: #scenario shows a scenario, #scenario/method opens a row ------------------------------------
  function go() {
    const part = openPart(), name = place(), isRow = Object.hasOwn(data.rows, name);
    const tab = tabs.querySelector("[aria-current]")?.textContent;
    document.title = [isRow && name.slice(part.id.length + 1), tab, title].filter(Boolean).join(" · ");
    const isNew = part && !part.shown;
    if (part) show(part);
    if (part && name === part.id) {
      if (!isNew && location.hash.includes("?")) part.take?.();
      part.keep?.();
    }
    if (isRow) return openRow(name);
    if (dialog.open) { stay(); dialog.close(); }
  }

  /* Give a part its behaviour and its pictures, once. */
  function show(part) {
    if (part.shown) return;
    part.shown = true;
    if (part.querySelector(".board")) prepare(part);
    if (part.id === "not-shown") prepareFiles(part);
    part.querySelectorAll(".heat, .definitions").forEach(roam);
    part.picture?.();
    drawOthers(part);
  }

  tabs.addEventListener("click", (event) => {
    const link = event.target.closest("a");
    if (!link || forNewTab(event)) return;
    event.preventDefault(); // the browser would scroll
    history.pushState(null, "", link.hash);
    go();
  });
  document.addEventListener("submit", (event) => event.preventDefault());
  // Back and forward change the address, too.
  window.addEventListener("popstate", go);
  window.addEventListener("resize", () => {
    measureTabs();
    for (const part of parts) {
      if (part.picture && part.size !== sizeOfPlane()) part.picture();
      if (part.shown && part.isNarrow !== narrow()) drawOthers(part);
    }
  });
  // An entry of the history that this page made for a row is "followed": closing the row leads back.
  if (!history.state) history.replaceState("landed", "");
  go();
  root.dataset.ready = ""; // for tests
})();
