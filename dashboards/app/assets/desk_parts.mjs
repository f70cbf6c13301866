// Building blocks of the correction and review pages. All texts are set as text, never as markup.

export function make(name, attributes, ...inside) {
  const made = document.createElement(name);
  Object.entries(attributes || {}).forEach(([key, value]) => {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
  });
  made.append(...inside);
  return made;
}

export function button(text, title, act, more) {
  return make("button", { type: "button", title, onclick: act, ...more }, text);
}

export function kept(name, value) {  // works without local storage as well
  try {
    if (value === undefined) return window.localStorage.getItem(name);
    window.localStorage.setItem(name, value);
  } catch { /* private window */ }
  return null;
}
