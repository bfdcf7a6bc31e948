/** The first paragraph of a Markdown text as plain text, for the line above the clips; a heading if there is no other. */
export function summaryOf(text: string): string {
  const withoutHeadings = text.replace(/^#{1,6}\s.*$/gm, "");
  return firstParagraph(withoutHeadings) || firstParagraph(text);
}

function firstParagraph(text: string): string {
  const paragraphs = text.split(/\n\s*\n/).map(plain);
  return paragraphs.find((paragraph) => paragraph !== "") ?? "";
}

function plain(paragraph: string): string {
  return paragraph
    .replace(/!\[[^\]]*\]\([^)]*\)/g, "")
    .replace(/\[([^\]]*)\]\([^)]*\)/g, "$1")
    .replace(/^\s*(#{1,6}|>|[-*+]|\d+[.)])\s+/gm, "")
    .replace(/(\*\*|__|~~|`)/g, "")
    .replace(/(^|\W)[*_](\S[^*_]*)[*_](?=\W|$)/g, "$1$2")
    .replace(/\s+/g, " ")
    .trim();
}
