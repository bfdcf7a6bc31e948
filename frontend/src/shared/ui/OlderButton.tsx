interface OlderButtonProps {
  /** a list that is loaded page by page, newest first */
  list: { hasNextPage: boolean; isFetchingNextPage: boolean; fetchNextPage: () => Promise<unknown> };
  /** what the list holds: "pairs" */
  what: string;
}

/** Loads the next page of a list. Nothing is shown where there is none. */
export function OlderButton({ list, what }: OlderButtonProps) {
  if (!list.hasNextPage) return null;
  return (
    <button
      type="button"
      className="button"
      disabled={list.isFetchingNextPage}
      onClick={() => void list.fetchNextPage()}
    >
      Older {what}
    </button>
  );
}
