// Tables are drawn here, as one piece: Dash's renderer needs a minute for the thousands of cells of a large study.
// Every text is set as text, never as markup.
(function () {
  "use strict";

  function element(name, attributes, text) {
    const made = document.createElement(name);
    Object.entries(attributes || {}).forEach(([key, value]) => value && made.setAttribute(key, value));
    if (text !== undefined) made.textContent = text;
    return made;
  }

  function go(event, href) {
    if (event.ctrlKey || event.metaKey || event.shiftKey || event.button) return;
    event.preventDefault();
    window.history.pushState({}, "", href);
    window.dispatchEvent(new CustomEvent("_dashprivate_pushstate"));
    window.scrollTo(0, 0);
  }

  function heading(head, table) {
    const th = element("th", { scope: "col", class: head.numeric ? "n" : "", "aria-sort": head.sort });
    const button = element("button", { type: "button" }, head.title);
    const arrow = { ascending: " ▲", descending: " ▼" }[head.sort];
    if (arrow) button.append(element("span", { "aria-hidden": "true" }, arrow));
    button.addEventListener("click", () =>
      window.dash_clientside.set_props(
        { part: "order", table: table.name }, { data: { column: head.column, down: head.sort === "ascending" } }));
    th.append(button);
    return th;
  }

  function cell(one, head) {
    const td = element("td", { class: one.kind === "said" ? "said" : head.numeric ? "n" : "" });
    if (one.kind === "state") {
      td.append(element("span", { class: "state is-" + one.to }, one.text));
    } else if (one.kind === "link") {
      const link = element("a", { href: one.to }, one.text);
      link.addEventListener("click", (event) => go(event, one.to));
      td.append(link);
    } else if (one.kind === "moment") {
      const button = element("button", { type: "button", class: "link", title: "look at this moment" }, one.text);
      button.addEventListener("click", () => window.dash_clientside.set_props("moment", { value: one.to }));
      td.append(button);
    } else {
      td.textContent = one.text;
    }
    return td;
  }

  function draw(table) {
    const place = table && document.getElementById(table.place);
    if (!place) return window.dash_clientside.no_update;
    const focused = place.contains(document.activeElement) ? document.activeElement.textContent : null;
    const drawn = element("table"), head = element("thead"), body = element("tbody"), top = element("tr");
    top.append(...table.heads.map((one) => heading(one, table)));
    head.append(top);
    body.append(...table.rows.map((row) => {
      const line = element("tr");
      line.append(...row.map((one, k) => cell(one, table.heads[k])));
      return line;
    }));
    drawn.append(head, body);
    place.replaceChildren(drawn, element("p", { class: "muted", role: "status" }, table.said));
    if (focused !== null) {  // sorting must not throw a keyboard's user back to the top
      const plain = focused.replace(/ [▲▼]$/, "");
      const again = [...place.querySelectorAll("th button")].find((one) => one.firstChild.textContent === plain);
      if (again) again.focus();
    }
    return "scroll";
  }

  // The desk is a module of its own, fetched when a session is opened.
  let desk = null;

  async function open(key, at) {  // figures keep a browser busy: they come after the first picture
    desk = import("/assets/desk.mjs");
    await (await desk).start(key, Number(at) || 0);
    return "desk is-open";
  }

  function moment(at) {
    if (desk) desk.then((module) => module.moment(at));
    return window.dash_clientside.no_update;
  }

  function cursor(at, came, unit, figure) {  // the line through the curves of the whole session
    const [line] = figure.layout.shapes, place = (Number(at) || 0) / unit;
    if (line.x0 === place) return window.dash_clientside.no_update;
    return { ...figure, layout: { ...figure.layout, shapes: [{ ...line, x0: place, x1: place }] } };
  }

  function again(made) {  // a correction was made, here or in the form
    if (desk && made) desk.then((module) => module.again(made));
    return window.dash_clientside.no_update;
  }

  async function review() {
    await (await import("/assets/review.mjs")).start();
    return "review is-open";
  }

  async function region(key) {
    await (await import("/assets/region.mjs")).start(key);
    return window.dash_clientside.no_update;
  }

  window.dash_clientside = Object.assign({}, window.dash_clientside, { liex: { draw: draw, open: open, moment: moment, cursor: cursor, again: again, review: review, region: region } });
})();
