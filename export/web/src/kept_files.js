// Files that the browser keeps for the page: takes, and the character that was chosen last.

const opened = () =>
  new Promise((resolve, reject) => {
    const asked = indexedDB.open("torchface", 1);
    asked.onupgradeneeded = () => asked.result.createObjectStore("files");
    asked.onsuccess = () => resolve(asked.result);
    asked.onerror = () => reject(asked.error);
  });
let database = null;

async function asked(mode, ask) {
  const files = (await (database ??= opened())).transaction("files", mode).objectStore("files");
  return new Promise((resolve, reject) => {
    const request = ask(files);
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

export const keepFile = (key, value) => asked("readwrite", (files) => files.put(value, key));
export const forgetFile = (key) => asked("readwrite", (files) => files.delete(key));
export const keptFile = (key) => asked("readonly", (files) => files.get(key));
/** All files whose key begins so. */
export const keptFiles = (prefix) => asked("readonly", (files) => files.getAll(IDBKeyRange.bound(prefix, `${prefix}\uffff`)));
