// Gains of the active dendrites (spiking/dendrites.py), and the heads with the
// combination of their outputs, which is linear, as one matrix; with their gradients. All in single precision.
//
// A actions, N neurons of all streams, one stream after the other, R rows (batch, or steps times batch).
// Every sum has one order, so it does not depend on the threads.

#include <algorithm>
#include <cmath>
#include <vector>

#include "numbers.h"

namespace {

struct Head {
    const float *weight, *bias, *combination;  // [outputs][inputs], [outputs], [outputs][A]
    float *grad_weight, *grad_bias;
    long inputs, outputs;
};

// A neuron's segments that win: their response, how many have it, and the first of them.
struct Winner {
    float response;
    long count, first;
};

Winner winner(const float* responses, long segments, long step, bool absolute) {
    Winner best = {responses[0], 1, 0};
    for (long s = 1; s < segments; s++) {
        float x = responses[s * step], size = absolute ? std::fabs(x) : x;
        float other = absolute ? std::fabs(best.response) : best.response;
        if (size > other || (std::isnan(size) && !std::isnan(other)))
            best = {x, 1, s};
        else if (size == other)
            best.count++;
    }
    return best;
}

inline float sigmoid(float x) { return 1.0f / (1.0f + std::exp(-x)); }

float dot(const float* a, const float* b, long size) {
    Lanes sums = {};
    for (long i = 0; i < size; i += WIDTH) {
        long width = std::min(WIDTH, size - i);
        sums += load(a + i, width) * load(b + i, width);
    }
    float sum = 0.0f;
    for (long i = 0; i < WIDTH; i++) sum += sums[i];
    return sum;
}

}  // namespace

extern "C" {

// gain [neurons] = sigmoid of the response to a task that wins, of segments [rows][segments][tasks]; one row is for all.
void snn_gains(const float* weights, long rows, long segments, long tasks, long task, int absolute, float* gain,
               long neurons) {
    for (long row = 0; row < rows; row++)
        gain[row] = sigmoid(winner(weights + row * segments * tasks + task, segments, tasks, absolute).response);
    if (rows == 1) std::fill(gain, gain + neurons, gain[0]);
}

// The segments' gradient; the largest share it if they are equal, of the largest by size the first one has it.
void snn_gains_backward(const float* weights, long rows, long segments, long tasks, long task, int absolute,
                        const float* grad_gain, float* grad_weights, long neurons) {
    std::fill(grad_weights, grad_weights + rows * segments * tasks, 0.0f);
    for (long row = 0; row < rows; row++) {
        const float* responses = weights + row * segments * tasks + task;
        Winner best = winner(responses, segments, tasks, absolute);
        double grad = 0.0;
        for (long n = row; n < (rows == 1 ? neurons : row + 1); n++) grad += grad_gain[n];
        float gain = sigmoid(best.response), share = float(grad) * gain * (1.0f - gain);
        for (long s = 0; s < segments; s++)
            if (absolute ? s == best.first : responses[s * tasks] == best.response)
                grad_weights[(row * segments + s) * tasks + task] = absolute ? share : share / float(best.count);
    }
}

// weight [A][N] and bias [A] of all heads and the combination of their outputs.
void snn_combine_heads(const Head* heads, long count, float* weight, float* bias, long N, long A) {
    std::fill(weight, weight + A * N, 0.0f);
    std::fill(bias, bias + A, 0.0f);
    for (const Head* head = heads; head < heads + count; weight += head->inputs, head++)
        for (long a = 0; a < A; a++)
            for (long j = 0; j < head->outputs; j++) {
                float factor = head->combination[j * A + a];
                bias[a] += factor * head->bias[j];
                for (long n = 0; n < head->inputs; n++) weight[a * N + n] += factor * head->weight[j * head->inputs + n];
            }
}

// q [R][A] = spikes [R][N] . weight [A][N]^T + bias [A].
void snn_read_out(const float* spikes, const float* weight, const float* bias, float* q, long R, long N, long A,
                  int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long r = 0; r < R; r++)
        for (long a = 0; a < A; a++) q[r * A + a] = dot(spikes + r * N, weight + a * N, N) + bias[a];
}

// From that of q [R][A]: gradients of the spikes [R][N], times scale, and of all heads.
void snn_heads_backward(const Head* heads, long count, const float* weight, const float* spikes, const float* grad_q,
                        float scale, float* grad_spikes, long R, long N, long A, int threads) {
    std::vector<float> totals(A, 0.0f);
    for (long i = 0; i < R * A; i++) totals[i % A] += grad_q[i];
    long first = 0;
    for (const Head* head = heads; head < heads + count; first += head->inputs, head++) {
        for (long j = 0; j < head->outputs; j++) head->grad_bias[j] = dot(head->combination + j * A, totals.data(), A);
#pragma omp parallel num_threads(threads)
        {
            std::vector<Lanes> sums(A);  // of the gradient of the weights [A][N]
#pragma omp for schedule(static)
            for (long c = 0; c < head->inputs; c += WIDTH) {
                long width = std::min(WIDTH, head->inputs - c), n = first + c;
                for (long a = 0; a < A; a++) sums[a] = Lanes{};
                for (long r = 0; r < R; r++) {
                    Lanes grad = {}, spike = load(spikes + r * N + n, width);
                    for (long a = 0; a < A; a++) {
                        float of_q = grad_q[r * A + a];
                        sums[a] += spike * of_q;
                        grad += load(weight + a * N + n, width) * of_q;
                    }
                    store(grad_spikes + r * N + n, grad * scale, width);
                }
                for (long j = 0; j < head->outputs; j++) {
                    Lanes sum = {};
                    for (long a = 0; a < A; a++) sum += sums[a] * head->combination[j * A + a];
                    store(head->grad_weight + j * head->inputs + c, sum, width);
                }
            }
        }
    }
}
}
