/* Work that is shared out to the threads that XLA has. */

#ifndef JAXIL_THREADS_H
#define JAXIL_THREADS_H

#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>

#include "xla/ffi/api/c_api.h"

/* What is done with a part of a call, of which there are so many. */
typedef void Work(void *call, size_t part);

/* Parts of a batch that are handed out one by one. The last of its users frees it. */
typedef struct {
  Work *work;
  void *call;
  size_t count;
  atomic_size_t next, done, users;
} Team;

static void leave(Team *team) {
  if (atomic_fetch_sub(&team->users, 1) == 1) free(team);
}

static void take_part(void *data) {
  Team *team = data;
  size_t part;
  while ((part = atomic_fetch_add(&team->next, 1)) < team->count) {
    team->work(team->call, part);
    atomic_fetch_add(&team->done, 1);
  }
  leave(team);
}

static int succeeded(XLA_FFI_CallFrame *frame, XLA_FFI_Error *error) {
  if (error == NULL) return 1;
  XLA_FFI_Error_Destroy_Args args = {
      .struct_size = XLA_FFI_Error_Destroy_Args_STRUCT_SIZE,
      .error = error,
  };
  frame->api->XLA_FFI_Error_Destroy(&args);
  return 0;
}

/* Returns how many threads XLA has; 1 where it doesn't tell. */
static size_t number_of_threads(XLA_FFI_CallFrame *frame) {
  int64_t threads = 1;
  XLA_FFI_ThreadPool_NumThreads_Args args = {
      .struct_size = XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE,
      .ctx = frame->ctx,
      .num_threads = &threads,
  };
  const int known = succeeded(frame, frame->api->XLA_FFI_ThreadPool_NumThreads(&args));
  return known && threads > 1 ? (size_t)threads : 1;
}

/* Works on all parts, with the threads of XLA that are free. A thread that comes too
   late finds none left; so only parts in work are waited for, and that always ends. */
static void for_each(size_t count, XLA_FFI_CallFrame *frame, Work *work, void *call) {
  const size_t threads = number_of_threads(frame);
  const size_t members = threads < count ? threads : count;
  Team *team = members > 1 ? malloc(sizeof(Team)) : NULL;
  if (team == NULL) {
    for (size_t part = 0; part < count; part++) work(call, part);
    return;
  }
  *team = (Team){.work = work, .call = call, .count = count};
  atomic_init(&team->users, members + 1); /* once more, for the one who waits */
  for (size_t k = 1; k < members; k++) {
    XLA_FFI_ThreadPool_Schedule_Args task = {
        .struct_size = XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE,
        .ctx = frame->ctx,
        .task = take_part,
        .data = team,
    };
    if (!succeeded(frame, frame->api->XLA_FFI_ThreadPool_Schedule(&task))) leave(team);
  }
  take_part(team);
  while (atomic_load(&team->done) < count) sched_yield();
  leave(team);
}

#endif
