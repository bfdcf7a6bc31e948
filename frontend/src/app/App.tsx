import { QueryClient, QueryClientProvider, useQuery } from "@tanstack/react-query";
import { useEffect } from "react";
import { SignedOut } from "@/features/session/SignedOut";
import { onSignedOut } from "@/shared/api/client";
import { ApiError, errorMessage } from "@/shared/api/errors";
import { meQuery, shouldRetry } from "@/shared/api/queries";
import { OutboxProvider } from "@/shared/outbox/OutboxProvider";
import { Message } from "@/shared/ui/Message";
import { Layout } from "./Layout";
import { Routes } from "./Routes";

const RECONNECT_MS = 2_000;

const cache = new QueryClient({
  defaultOptions: { queries: { retry: shouldRetry, staleTime: 1_000 } },
});

export function App() {
  return (
    <QueryClientProvider client={cache}>
      <Session />
    </QueryClientProvider>
  );
}

/** The app for a signed-in user, or the sign-in page. */
function Session() {
  const me = useQuery({ ...meQuery, refetchInterval: (query) => (query.state.error ? RECONNECT_MS : false) });
  // Any request can be the first to find that the session ended: load the user again, which shows the sign-in page.
  useEffect(() => onSignedOut(() => void cache.invalidateQueries({ queryKey: meQuery.queryKey })), []);
  // Checked before `data`: the cache still holds the user after the session ended.
  if (me.error instanceof ApiError && me.error.status === 401) return <SignedOut previous={me.data} />;
  if (me.data) {
    return (
      <OutboxProvider userId={me.data.id}>
        <Layout me={me.data}>
          <Routes me={me.data} />
        </Layout>
      </OutboxProvider>
    );
  }
  if (me.error) {
    return (
      <Message title="Cannot reach Accord">
        <p>{errorMessage(me.error)} This page reconnects automatically.</p>
      </Message>
    );
  }
  return null;
}
