/* Sorts the rows of a table by the column whose head is clicked, or chosen with the keyboard. */
(function () {
'use strict';
/* The number that a text begins with; null for other texts. */
function number(text) {
  var found = /^[\u2212-]?[\d\u202f]+(\.\d+)?([eE][\u2212+-]?\d+)?/.exec(text);
  return found ? Number(found[0].replace(/\u2212/g, '-').replace(/\u202f/g, '')) : null;
}
function compare(a, b) {
  var x = number(a), y = number(b);
  if (x !== null && y !== null) { return x - y; }
  if (x !== null || y !== null) { return x !== null ? -1 : 1; }  /* numbers first, then texts */
  return a.localeCompare(b, undefined, {numeric: true});
}
function sort(table, heads, column) {
  var down = heads[column].getAttribute('aria-sort') === 'ascending', body = table.tBodies[0];
  var rows = Array.prototype.map.call(body.rows, function (row, place) {
    return {row: row, place: place, text: row.cells[column].textContent.trim()};
  });
  rows.sort(function (a, b) {
    return (down ? -1 : 1) * compare(a.text, b.text) || a.place - b.place;
  });
  rows.forEach(function (one) { body.appendChild(one.row); });
  heads.forEach(function (head, k) {
    if (k === column) { head.setAttribute('aria-sort', down ? 'descending' : 'ascending'); }
    else { head.removeAttribute('aria-sort'); }
  });
}
Array.prototype.forEach.call(document.querySelectorAll('table.sortable'), function (table) {
  var heads = Array.prototype.slice.call(table.tHead.rows[0].cells);
  heads.forEach(function (head, column) {
    head.tabIndex = 0;
    head.addEventListener('click', function () { sort(table, heads, column); });
    head.addEventListener('keydown', function (event) {
      if (event.key === 'Enter' || event.key === ' ') { event.preventDefault(); sort(table, heads, column); }
    });
  });
});
}());
